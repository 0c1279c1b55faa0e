//! A headless Chromium behind its driver, spoken to by the `WebDriver` protocol (<https://www.w3.org/TR/webdriver2/>). Nothing waits without an end, and driver and
//! browser die with their owner: the kernel ends the driver with the thread that started it, and the browser ends when its pipe to the driver closes.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Once, mpsc};
use std::thread;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use ureq::Agent;

const PROGRAM: &str = "chromedriver";
const REQUIRE_ALL: &str = "PLATEBENCH_REQUIRE_ALL";
static NOTICE_ONCE: Once = Once::new();

/// Generous: a busy machine starts programs slowly.
const DRIVER_TIMEOUT: Duration = Duration::from_mins(1);
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// How the page is looked at.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BrowserOptions {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) dark: bool,
    pub(crate) scripts: bool,
}

/// A running browser with one window.
pub(crate) struct Browser {
    driver: Child,
    agent: Agent,
    session: String,
    /// The browser's own files.
    _profile: TempDir,
}

/// Kills the driver unless it is taken out.
struct ChildGuard(Option<Child>);

impl Drop for ChildGuard {
    fn drop(&mut self) {
        if let Some(driver) = &mut self.0 {
            kill_driver(driver);
        }
    }
}

fn kill_driver(driver: &mut Child) {
    let _ = driver.kill();
    let _ = driver.wait();
}

impl Browser {
    /// A fresh browser; `None`, with a line that nobody can miss, where the driver is not installed and nobody insists.
    pub(crate) fn start_if_installed(look: BrowserOptions) -> Option<Self> {
        match Command::new(PROGRAM).arg("--version").stdin(Stdio::null()).output() {
            Ok(_) => Some(Self::start(look)),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let all = std::env::var(REQUIRE_ALL).is_ok_and(|value| value == "1");
                assert!(!all, "{PROGRAM} is not installed and {REQUIRE_ALL}=1: ci/install-test-tools");
                // Not by `eprintln!`, which the test harness keeps to itself while a test passes.
                NOTICE_ONCE.call_once(|| {
                    let _ = writeln!(std::io::stderr(), "left out: {PROGRAM} is not installed (ci/install-test-tools)");
                });
                None
            }
            Err(error) => panic!("{PROGRAM}: {error}"),
        }
    }

    fn start(look: BrowserOptions) -> Self {
        let profile = TempDir::new().unwrap();
        let mut driver = Command::new("setpriv")
            .args(["--pdeathsig", "KILL", "--", PROGRAM, "--port=0"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let output = driver.stdout.take().unwrap();
        let mut guard = ChildGuard(Some(driver));
        let (sender, receiver) = mpsc::channel();
        // Ends with the driver, which closes its output.
        thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                // Before, it says that it starts on the port that it was asked for, which is 0.
                let port = line.rsplit_once("successfully on port ");
                let port = port.and_then(|(_, port)| port.trim_end_matches('.').parse::<u16>().ok());
                if let Some(port) = port {
                    let _ = sender.send(port);
                }
            }
        });
        let port = receiver.recv_timeout(DRIVER_TIMEOUT).expect("the driver says on which port it listens");
        let agent = Agent::config_builder().timeout_global(Some(DRIVER_TIMEOUT)).http_status_as_error(false).build();
        let agent = Agent::new_with_config(agent);
        let profile_argument = format!("--user-data-dir={}", profile.path().display());
        // As root, as in containers, Chromium wants no sandbox; the only page that it sees is ours.
        let arguments = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--remote-debugging-pipe",
            "--hide-scrollbars",
            &profile_argument,
        ];
        let wanted = json!({ "capabilities": { "alwaysMatch": {
            "goog:chromeOptions": { "args": arguments },
            "goog:loggingPrefs": { "browser": "ALL" },
        } } });
        let root = format!("http://127.0.0.1:{port}/session");
        let made = post(&agent, &root, &wanted);
        let session = format!("{root}/{}", made["sessionId"].as_str().unwrap_or_else(|| panic!("no session: {made}")));
        let driver = guard.0.take().unwrap();
        let browser = Self { driver, agent, session, _profile: profile };
        let BrowserOptions { width, height, dark, scripts } = look;
        let phone = width < 600;
        browser.devtools_command(
            "Emulation.setDeviceMetricsOverride",
            &json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone }),
        );
        let scheme = if dark { "dark" } else { "light" };
        browser.devtools_command(
            "Emulation.setEmulatedMedia",
            &json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }] }),
        );
        browser.devtools_command("Emulation.setScriptExecutionDisabled", &json!({ "value": !scripts }));
        browser
    }

    /// A command of the browser's own protocol.
    pub(crate) fn devtools_command(&self, command: &str, parameters: &Value) -> Value {
        self.post("goog/cdp/execute", &json!({ "cmd": command, "params": parameters }))
    }

    fn post(&self, command: &str, body: &Value) -> Value {
        post(&self.agent, &format!("{}/{command}", self.session), body)
    }

    pub(crate) fn open(&self, page: &Path) {
        self.post("url", &json!({ "url": format!("file://{}", page.display()) }));
    }

    /// What `expression` is in the page, a promise's value when it comes.
    pub(crate) fn evaluate(&self, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let answer = self.devtools_command("Runtime.evaluate", &parameters);
        assert!(answer.get("exceptionDetails").is_none(), "{expression:.200}: {answer}");
        answer["result"]["value"].clone()
    }

    /// Waits until `expression` holds in the page.
    pub(crate) fn wait_for(&self, expression: &str) {
        let started = Instant::now();
        while self.evaluate(expression) != json!(true) {
            assert!(started.elapsed() < DRIVER_TIMEOUT, "it never came: {expression}");
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Presses at `from`, moves to `to` and lets go; places in the window.
    pub(crate) fn drag(&self, from: (f64, f64), to: (f64, f64)) {
        let go = |(x, y): (f64, f64)| json!({ "type": "pointerMove", "duration": 50, "x": x.round(), "y": y.round() });
        let middle = (f64::midpoint(from.0, to.0), to.1);
        let acts = json!([go(from), { "type": "pointerDown", "button": 0 }, go(middle), go(to), { "type": "pointerUp", "button": 0 }]);
        let pointer =
            json!({ "type": "pointer", "id": "mouse", "parameters": { "pointerType": "mouse" }, "actions": acts });
        self.post("actions", &json!({ "actions": [pointer] }));
    }

    /// Puts the pointer there.
    pub(crate) fn move_pointer(&self, (x, y): (f64, f64)) {
        let acts = json!([{ "type": "pointerMove", "duration": 20, "x": x.round(), "y": y.round() }]);
        let pointer =
            json!({ "type": "pointer", "id": "mouse", "parameters": { "pointerType": "mouse" }, "actions": acts });
        self.post("actions", &json!({ "actions": [pointer] }));
    }

    /// What the page said on its console since this was last asked: warnings and errors.
    pub(crate) fn console_messages(&self) -> Vec<Value> {
        let said = self.post("se/log", &json!({ "type": "browser" }));
        let said = said.as_array().unwrap_or_else(|| panic!("no log: {said}")).iter();
        said.filter(|entry| ["SEVERE", "WARNING"].contains(&entry["level"].as_str().unwrap())).cloned().collect()
    }

    /// Keeps what the window shows as `name`.png, where pictures are asked for.
    pub(crate) fn save_screenshot(&self, name: &str) {
        let Some(folder) = std::env::var_os("REPORT_PICTURES") else { return };
        let answer = self.devtools_command("Page.captureScreenshot", &json!({ "format": "png" }));
        let mut decoder =
            Command::new("base64").arg("--decode").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let mut input = decoder.stdin.take().unwrap();
        let text = answer["data"].as_str().unwrap().to_owned();
        let writer = thread::spawn(move || input.write_all(text.as_bytes()).unwrap());
        let picture = decoder.wait_with_output().unwrap().stdout;
        writer.join().unwrap();
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(Path::new(&folder).join(format!("{name}.png")), picture).unwrap();
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The orderly way lets the browser clear its files away; the other one always works.
        let _ = self.agent.delete(&self.session).config().timeout_global(Some(Duration::from_secs(10))).build().call();
        kill_driver(&mut self.driver);
    }
}

fn post(agent: &Agent, url: &str, body: &Value) -> Value {
    let mut answer = agent.post(url).header("content-type", "application/json").send(body.to_string()).unwrap();
    let text = answer.body_mut().with_config().limit(64 << 20).read_to_string().unwrap();
    let mut answer: Value = serde_json::from_str(&text).unwrap();
    let value = answer["value"].take();
    assert!(value.get("error").is_none(), "{url}: {value}");
    value
}
