//! Runs a controller program in a process group of its own and ends it in bounded time.

use super::output::OutputRelay;
use crate::cancel::CancelToken;
use rustix::fs::{Access, access};
use rustix::process::{Pid, Signal, WaitId, WaitIdOptions, WaitIdStatus, getpgid, kill_process_group, waitid};
use std::fs;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tracing::{debug, warn};

/// Longest wait for the program's exit after the hang-up, and again after SIGTERM.
const EXIT_GRACE: Duration = Duration::from_millis(500);
/// The same after a cancellation, so that Ctrl-C ends the bench within a second.
const CANCELLED_EXIT_GRACE: Duration = Duration::from_millis(100);
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Environment variable that marks the program and all processes that it starts.
const MARKER: &str = "PLATEBENCH_PROGRAM";

/// Dropping the value ends the program's process group.
#[derive(Debug)]
pub(crate) struct Program {
    name: String,
    child: Child,
    marker: String,
    cancel: CancelToken,
    // Dropped after the program has ended, so that its last lines are printed.
    _output: OutputRelay,
}

impl Program {
    pub(crate) fn start(
        name: &str,
        arguments: impl Iterator<Item = String>,
        port: &str,
        cancel: CancelToken,
    ) -> io::Result<Self> {
        let (output, writer) = io::pipe()?;
        let marker = format!("{} {port}", std::process::id());
        let mut command = command(name);
        command.args(arguments).env(MARKER, &marker).process_group(0).stdin(Stdio::null());
        command.stdout(writer.try_clone()?).stderr(writer);
        let output = OutputRelay::start(name, output)?;
        let child = command.spawn()?;
        // The command keeps the bench's ends of the pipe, which must close at the program's end.
        drop(command);
        Ok(Self { name: name.to_owned(), child, marker, cancel, _output: output })
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    pub(crate) fn process_id(&self) -> u32 {
        self.child.id()
    }

    pub(crate) fn cancel(&self) -> &CancelToken {
        &self.cancel
    }

    fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Returns a description of the exit; `None` if the program runs. The program remains a zombie, so
    /// that its process number and group are not used again.
    pub(crate) fn exit(&self) -> Option<String> {
        self.wait_for_exit(Duration::ZERO)
    }

    /// Like [`Self::exit`]; `None` on time-out. A cancellation shortens the wait.
    pub(crate) fn wait_for_exit(&self, timeout: Duration) -> Option<String> {
        let started = Instant::now();
        let is_over = || {
            let waited = started.elapsed();
            waited >= timeout || (waited >= CANCELLED_EXIT_GRACE && self.cancel.is_cancelled())
        };
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
        loop {
            match waitid(WaitId::Pid(self.pid()), options) {
                Ok(Some(status)) => return Some(exit_description(&status)),
                Ok(None) if !is_over() => std::thread::sleep(POLL_INTERVAL),
                Ok(None) => return None,
                Err(error) => return Some(format!("is gone ({error})")),
            }
        }
    }

    fn processes_outside_group(&self) -> Vec<u32> {
        let marker = format!("{MARKER}={}", self.marker).into_bytes();
        let numbers = fs::read_dir("/proc").into_iter().flatten().flatten();
        let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
        let is_marked = |pid: &u32| {
            let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
            environment.split(|&byte| byte == 0).any(|variable| variable == marker)
        };
        let group = self.pid();
        let is_outside = |pid: &u32| {
            let pid = i32::try_from(*pid).ok().and_then(Pid::from_raw);
            pid.is_some_and(|pid| getpgid(Some(pid)).is_ok_and(|other| other != group))
        };
        numbers.filter(is_marked).filter(is_outside).collect()
    }

    fn signal(&self, signal: Signal) {
        if let Err(error) = kill_process_group(self.pid(), signal) {
            debug!(?signal, %error, "the signal did not reach the program's group");
        }
    }
}

/// `scancel` sends SIGTERM to every process of a job. A program that does not handle it would end
/// before the bench has its 0 V, so it is started with SIGTERM ignored.
fn command(name: &str) -> Command {
    let mut command = Command::new(name);
    // Without an executable file, the error of the start names the program.
    if std::env::var_os("SLURM_JOB_ID").is_some() && is_executable(name) {
        command = Command::new("/bin/sh");
        command.args(["-c", r#"trap "" TERM; exec "$0" "$@""#, name]);
    }
    command
}

fn is_executable(name: &str) -> bool {
    let path = std::env::var_os("PATH").filter(|_| !name.contains('/')).unwrap_or_else(|| "".into());
    let is_program = |folder: PathBuf| {
        let file = folder.join(name);
        file.is_file() && access(&file, Access::EXEC_OK).is_ok()
    };
    std::env::split_paths(&path).any(is_program)
}

fn exit_description(status: &WaitIdStatus) -> String {
    match (status.exit_status(), status.terminating_signal()) {
        (Some(code), _) => format!("ended with exit status {code}"),
        (None, Some(signal)) => format!("was ended by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let mut ended = self.wait_for_exit(EXIT_GRACE);
        if ended.is_none() {
            warn!(program = self.name, "the program still runs after its line hung up: sending SIGTERM");
            self.signal(Signal::TERM);
            ended = self.wait_for_exit(EXIT_GRACE);
        }
        if ended.is_none() {
            warn!(program = self.name, "the program still runs after SIGTERM: sending SIGKILL");
        }
        // SIGKILL also ends the other processes of the group.
        self.signal(Signal::KILL);
        let left = self.processes_outside_group();
        if !left.is_empty() {
            let name = &self.name;
            warn!(program = name, pids = ?left,
                "processes that the program started have left its process group; they still run, end them by hand");
        }
        if let Some(how) = ended.or_else(|| self.wait_for_exit(EXIT_GRACE)) {
            debug!(program = self.name, how, status = ?self.child.wait(), "program ended");
        } else {
            // The process is blocked in the kernel. A wait for its end could block the bench, too.
            warn!(
                program = self.name,
                pid = self.child.id(),
                "the program still runs after SIGKILL and is left running"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::process::kill_process;

    /// False for a process that has ended or is a zombie.
    fn is_running(pid: &str) -> bool {
        let status = fs::read_to_string(format!("/proc/{}/stat", pid.trim())).unwrap_or_default();
        status.rsplit_once(')').is_some_and(|(_, rest)| !rest.trim_start().starts_with('Z'))
    }

    fn script(folder: &tempfile::TempDir, text: &str) -> (Program, Vec<String>) {
        cancellable_script(folder, text, &CancelToken::never())
    }

    fn cancellable_script(folder: &tempfile::TempDir, text: &str, cancel: &CancelToken) -> (Program, Vec<String>) {
        let pids_file = folder.path().join("pids");
        let arguments = ["-c".to_owned(), text.to_owned(), pids_file.display().to_string()];
        let program = Program::start("sh", arguments.into_iter(), &folder.path().display().to_string(), cancel.clone());
        let deadline = Instant::now() + Duration::from_secs(10);
        loop {
            let pids = fs::read_to_string(&pids_file).unwrap_or_default();
            if pids.ends_with("done\n") {
                return (program.unwrap(), pids.lines().filter(|line| *line != "done").map(str::to_owned).collect());
            }
            assert!(Instant::now() < deadline, "the script does not start");
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    #[test]
    fn kills_a_program_that_ignores_signals_and_its_group() {
        let folder = tempfile::tempdir().unwrap();
        let text = r#"trap "" TERM HUP; sleep 60 & echo $$ >"$0"; echo $! >>"$0"; echo done >>"$0"
            while :; do sleep 1; done"#;
        let (program, pids) = script(&folder, text);
        assert_eq!(pids.len(), 2);
        assert!(pids.iter().all(|pid| is_running(pid)));
        drop(program);
        // The test cannot wait for the program's child, and the kernel ends a killed process later.
        let deadline = Instant::now() + Duration::from_secs(10);
        while pids.iter().any(|pid| is_running(pid)) {
            assert!(Instant::now() < deadline, "{pids:?}");
            std::thread::sleep(POLL_INTERVAL);
        }
    }

    #[test]
    fn a_cancellation_shortens_the_wait_for_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let cancel = CancelToken::never();
        let text = r#"trap "" TERM HUP; echo done >"$0"; while :; do sleep 0.01; done"#;
        let (program, _) = cancellable_script(&folder, text, &cancel);
        cancel.cancel();
        // Without the cancellation, it waits for an hour.
        assert_eq!(program.wait_for_exit(Duration::from_hours(1)), None);
    }

    #[test]
    fn lets_a_program_end_by_itself_after_sigterm() {
        let folder = tempfile::tempdir().unwrap();
        let text = r#"trap "echo ended >>\"$0\"; exit 0" TERM; echo done >"$0"; while :; do sleep 0.01; done"#;
        let (program, _) = script(&folder, text);
        drop(program);
        assert!(fs::read_to_string(folder.path().join("pids")).unwrap().ends_with("ended\n"));
    }

    #[test]
    fn finds_processes_that_left_the_group() {
        let folder = tempfile::tempdir().unwrap();
        let text = r#"setsid sleep 60 & echo $! >"$0"; echo done >>"$0"; while :; do sleep 0.01; done"#;
        let (program, pids) = script(&folder, text);
        let deadline = Instant::now() + Duration::from_secs(10);
        let left = loop {
            let left = program.processes_outside_group();
            if !left.is_empty() || Instant::now() > deadline {
                break left;
            }
            std::thread::sleep(POLL_INTERVAL);
        };
        assert_eq!(left.iter().map(u32::to_string).collect::<Vec<_>>(), pids);
        drop(program);
        assert!(is_running(&pids[0]), "the bench does not end what left the group");
        kill_process(Pid::from_raw(pids[0].parse().unwrap()).unwrap(), Signal::KILL).unwrap();
    }
}
