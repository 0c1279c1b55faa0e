//! Plays a campaign in shards on an engine, kills shards, and compares the results with those of one
//! thread.

use crate::board_matrix::start_line;
use crate::campaign::{self, results};
use crate::test_folder::{ChildGuard, wait_until};
use platebench_test_kit::skip_without;
use std::fs;
use std::net::{Ipv4Addr, TcpListener};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

const KILLS: usize = 3;
const SHARDS: u32 = 4;

fn kill_a_shard(folder: &Path, random: usize) -> bool {
    let is_shard = |process: &String| {
        let words = fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
        let is_here = fs::read_link(format!("/proc/{process}/cwd")).is_ok_and(|path| path == folder);
        words.contains("\0campaign\0play\0") && (is_here || words.contains(&*folder.to_string_lossy()))
    };
    let all = fs::read_dir("/proc").unwrap().flatten().filter_map(|entry| entry.file_name().into_string().ok());
    let shards: Vec<_> = all.filter(|name| name.parse::<u32>().is_ok()).filter(is_shard).collect();
    let Some(shard) = shards.get(random % shards.len().max(1)) else { return false };
    Command::new("kill").args(["-KILL", shard]).stderr(Stdio::null()).status().unwrap().success()
}

/// Submits the line of `campaign submit` that begins with `begin`. The engine ends with the code
/// `exit` if a shard was killed.
pub(crate) fn assert_same_bytes(engine: &str, begin: &str, start: &dyn Fn(&Path, &str) -> ChildGuard, exit: i32) {
    let folder = campaign::folder("[plan]\nmethod = \"random\"\ntrials = 4000\n");
    let alone = folder.bench(["campaign", "run", "campaign.toml", "--jobs", "1", "--out", "alone"]).exit;
    campaign::plan(&folder, "c", SHARDS);
    let printed = folder.bench(["campaign", "submit", "c", "--on", engine]).assert_exit(0).stdout;
    let line = printed.lines().find(|line| line.starts_with(begin)).unwrap();
    let mut submission = start(folder.path(), line);
    let mut kills = 0;
    while !submission.has_ended() {
        // The number of kills so far selects the next shard to kill.
        kills += usize::from(kills < KILLS && kill_a_shard(folder.path(), kills));
        thread::sleep(Duration::from_millis(20));
    }
    assert!(kills > 0, "no shard was killed");
    submission.finish().assert_exit(exit);
    folder.bench(["campaign", "merge", "c"]).assert_exit(3).assert_stdout(&["missing shards"]);
    start(folder.path(), line).finish().assert_exit(0);
    assert_eq!(folder.bench(["campaign", "merge", "c"]).exit, alone);
    assert!(results(&folder, "c") == results(&folder, "alone"), "the results depend on killed shards");
}

/// Slurm cluster of one controller and one node on this machine, run by this user.
pub(crate) struct Slurm {
    /// The first field is dropped first, so that the daemons end before their folder is removed.
    daemons: Vec<ChildGuard>,
    folder: tempfile::TempDir,
}

impl Slurm {
    pub(crate) fn start() -> Option<Self> {
        let output = |program: &str, argument: &str| {
            let output = Command::new(program).arg(argument).output().ok().filter(|output| output.status.success())?;
            Some(String::from_utf8(output.stdout).unwrap().trim().to_owned())
        };
        if output("slurmctld", "-V").is_none() || output("slurmd", "-V").is_none() {
            skip_without("slurmctld and slurmd");
            return None;
        }
        let (host, user) = (output("hostname", "-s").unwrap(), output("id", "-un").unwrap());
        let folder = tempfile::tempdir().unwrap();
        let sockets = [(); 2].map(|()| TcpListener::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap());
        let [control, node] = sockets.each_ref().map(|socket| socket.local_addr().unwrap().port());
        drop(sockets);
        let path = folder.path().display();
        // By default Slurm starts a task every 3 s. `sbatch --wait` asks after 2, 10 and 42 s, so the
        // tasks must end within 10 s.
        let config = format!(
            "ClusterName=test\nSlurmctldHost={host}(127.0.0.1)\nAuthType=auth/none\nCredType=cred/none\n\
             SlurmUser={user}\nSlurmdUser={user}\nSlurmctldPort={control}\nSlurmdPort={node}\n\
             StateSaveLocation={path}/state\nSlurmdSpoolDir={path}/spool\n\
             SlurmctldPidFile={path}/slurmctld.pid\nSlurmdPidFile={path}/slurmd.pid\n\
             ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\nSelectType=select/cons_tres\n\
             ReturnToService=2\nMpiDefault=none\nSlurmdParameters=config_overrides\n\
             SchedulerParameters=batch_sched_delay=0,sched_min_interval=0,sched_interval=1\n\
             NodeName={host} NodeAddr=127.0.0.1 CPUs={SHARDS} State=UNKNOWN\n\
             PartitionName=all Nodes=ALL Default=YES State=UP\n"
        );
        fs::write(folder.path().join("slurm.conf"), config).unwrap();
        let mut slurm = Self { daemons: Vec::new(), folder };
        for program in ["slurmctld", "slurmd"] {
            let mut daemon = slurm.command(program);
            daemon.arg("-D").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            slurm.daemons.push(ChildGuard(daemon.spawn().unwrap()));
        }
        wait_until("the node of Slurm is not ready", || {
            let states = slurm.command("sinfo").args(["--noheader", "--format", "%T"]).output().unwrap();
            String::from_utf8_lossy(&states.stdout).trim() == "idle"
        });
        Some(slurm)
    }

    fn config(&self) -> String {
        self.folder.path().join("slurm.conf").to_str().unwrap().to_owned()
    }

    pub(crate) fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("SLURM_CONF", self.config());
        command
    }
}

#[test]
fn shards_killed_on_slurm_resume_to_the_same_bytes() {
    let Some(slurm) = Slurm::start() else { return };
    let config = slurm.config();
    let start = |folder: &Path, line: &str| start_line(folder, line, &[("SLURM_CONF", config.as_str())]);
    // Exit code after SIGKILL: 128 + 9.
    assert_same_bytes("slurm", "sbatch", &start, 137);
}
