//! Controls a headless Chromium by the `WebDriver` protocol (<https://www.w3.org/TR/webdriver2/>).
//! The kernel ends the driver with its thread; the browser ends when its pipe to the driver closes.

use platebench_test_kit::{ChildGuard, skip_without};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use ureq::Agent;

const PROGRAM: &str = "chromedriver";

const DRIVER_TIMEOUT: Duration = Duration::from_mins(1);
const POLL_INTERVAL: Duration = Duration::from_millis(50);

#[derive(Debug, Clone, Copy)]
pub(crate) struct BrowserOptions {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) dark: bool,
    pub(crate) scripts: bool,
}

pub(crate) struct Browser {
    _driver: ChildGuard,
    agent: Agent,
    session: String,
    _profile: TempDir,
}

impl Browser {
    /// Prints a message and returns `None` if the driver is neither installed nor required.
    pub(crate) fn start_if_installed(options: BrowserOptions) -> Option<Self> {
        match Command::new(PROGRAM).arg("--version").stdin(Stdio::null()).output() {
            Ok(_) => Some(Self::start(options)),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                skip_without(PROGRAM);
                None
            }
            Err(error) => panic!("{PROGRAM}: {error}"),
        }
    }

    fn start(options: BrowserOptions) -> Self {
        let profile = TempDir::new().unwrap();
        let mut driver = Command::new("setpriv")
            .args(["--pdeathsig", "KILL", "--", PROGRAM, "--port=0"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let output = driver.stdout.take().unwrap();
        let driver = ChildGuard(driver);
        let (sender, receiver) = mpsc::channel();
        // The thread ends when the driver closes its output.
        thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                // An earlier line names the requested port 0.
                let port = line.rsplit_once("successfully on port ");
                let port = port.and_then(|(_, port)| port.trim_end_matches('.').parse::<u16>().ok());
                if let Some(port) = port {
                    let _ = sender.send(port);
                }
            }
        });
        let port = receiver.recv_timeout(DRIVER_TIMEOUT).expect("the driver names its port");
        let agent = Agent::config_builder().timeout_global(Some(DRIVER_TIMEOUT)).http_status_as_error(false).build();
        let agent = Agent::new_with_config(agent);
        let profile_argument = format!("--user-data-dir={}", profile.path().display());
        // As root, as in containers, Chromium needs `--no-sandbox`.
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
        let capabilities = json!({ "capabilities": { "alwaysMatch": {
            "goog:chromeOptions": { "args": arguments },
            "goog:loggingPrefs": { "browser": "ALL" },
        } } });
        let root = format!("http://127.0.0.1:{port}/session");
        let created = post(&agent, &root, &capabilities);
        let session =
            format!("{root}/{}", created["sessionId"].as_str().unwrap_or_else(|| panic!("no session: {created}")));
        let browser = Self { _driver: driver, agent, session, _profile: profile };
        let BrowserOptions { width, height, dark, scripts } = options;
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

    pub(crate) fn devtools_command(&self, command: &str, parameters: &Value) -> Value {
        self.post("goog/cdp/execute", &json!({ "cmd": command, "params": parameters }))
    }

    fn post(&self, command: &str, body: &Value) -> Value {
        post(&self.agent, &format!("{}/{command}", self.session), body)
    }

    pub(crate) fn open(&self, page: &Path) {
        self.post("url", &json!({ "url": format!("file://{}", page.display()) }));
    }

    pub(crate) fn evaluate(&self, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let answer = self.devtools_command("Runtime.evaluate", &parameters);
        assert!(answer.get("exceptionDetails").is_none(), "{expression:.200}: {answer}");
        answer["result"]["value"].clone()
    }

    pub(crate) fn wait_for(&self, expression: &str) {
        let started = Instant::now();
        while self.evaluate(expression) != json!(true) {
            assert!(started.elapsed() < DRIVER_TIMEOUT, "never true: {expression}");
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Both positions are in coordinates of the window.
    pub(crate) fn drag(&self, from: (f64, f64), to: (f64, f64)) {
        let pointer_to =
            |(x, y): (f64, f64)| json!({ "type": "pointerMove", "duration": 50, "x": x.round(), "y": y.round() });
        let middle = (f64::midpoint(from.0, to.0), to.1);
        let (down, up) = (json!({ "type": "pointerDown", "button": 0 }), json!({ "type": "pointerUp", "button": 0 }));
        self.act(&json!([pointer_to(from), down, pointer_to(middle), pointer_to(to), up]));
    }

    pub(crate) fn move_pointer(&self, (x, y): (f64, f64)) {
        self.act(&json!([{ "type": "pointerMove", "duration": 20, "x": x.round(), "y": y.round() }]));
    }

    fn act(&self, actions: &Value) {
        let parameters = json!({ "pointerType": "mouse" });
        let pointer = json!({ "type": "pointer", "id": "mouse", "parameters": parameters, "actions": actions });
        self.post("actions", &json!({ "actions": [pointer] }));
    }

    pub(crate) fn console_messages(&self) -> Vec<Value> {
        let log = self.post("se/log", &json!({ "type": "browser" }));
        let entries = log.as_array().unwrap_or_else(|| panic!("no log: {log}")).iter();
        entries.filter(|entry| ["SEVERE", "WARNING"].contains(&entry["level"].as_str().unwrap())).cloned().collect()
    }

    /// Saves nothing unless the variable `REPORT_PICTURES` names a folder.
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
        // Lets the browser delete its files before the driver is killed.
        let _ = self.agent.delete(&self.session).config().timeout_global(Some(Duration::from_secs(10))).build().call();
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
