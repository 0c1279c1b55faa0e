//! Builds the C starter, tests it on the emulated rig, and tests its protocol on this computer.
//!
//! The firmware needs `make`, `gcc-arm-none-eabi` and newlib (`ci/install-test-tools`).

use crate::test_folder::{TestFolder, run_bench, workspace_root};
use platebench_model::record::{RunRecord, Verdict};
use platebench_test_kit::skip_without;
use platebench_wire::{Configure, FrameReader, Gains, Message, Packet, Sample};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

fn starter() -> PathBuf {
    workspace_root().join("firmware-under-test/starter-c")
}

pub(crate) fn has_cross_compiler() -> bool {
    let path = |arguments: &[&str]| {
        let output = Command::new("arm-none-eabi-gcc").args(arguments).output().ok()?;
        String::from_utf8(output.stdout).ok()
    };
    let has_make = Command::new("make").arg("--version").output().is_ok_and(|output| output.status.success());
    has_make && path(&["--print-file-name=nano.specs"]).is_some_and(|file| Path::new(file.trim()).is_file())
}

pub(crate) fn build_starter(folder: &Path) -> PathBuf {
    build_starter_with(folder, &[])
}

fn build_starter_with(folder: &Path, settings: &[&str]) -> PathBuf {
    let folder_setting = format!("BUILD={}", folder.display());
    let output = Command::new("make").arg("-C").arg(starter()).arg(folder_setting).args(settings).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    folder.join("starter.elf")
}

#[test]
fn the_c_starter_passes_the_default_suite() {
    if !has_cross_compiler() {
        return skip_without("make, arm-none-eabi-gcc or newlib");
    }
    let folder = TestFolder::new();
    let rig = format!("emulated:{}", build_starter(&folder.join("build")).display());
    let out = folder.join("run");
    let arguments = ["run", "--rig", &rig, "--out", out.to_str().unwrap()];
    run_bench(&workspace_root(), arguments).assert_exit(0);
    let record = RunRecord::read(&out).unwrap();
    assert_eq!(record.verdict, Verdict::Pass);
    let played = |name: &str| record.scenarios.iter().any(|scenario| scenario.file == name);
    assert!(
        played("paper/fig13-closed-loop.toml") && played("faults/five-periods-of-silence.toml"),
        "{:?}",
        record.verdict
    );
}

#[test]
fn the_c_starter_without_laws_has_an_own_law() {
    if !has_cross_compiler() {
        return skip_without("make, arm-none-eabi-gcc or newlib");
    }
    let folder = TestFolder::new();
    let elf = build_starter_with(&folder.join("build"), &["CFLAGS_BOARD=-DANNOUNCED_LAWS=0u"]);
    let out = folder.join("run");
    let rig = format!("emulated:{}", elf.display());
    let arguments = ["run", "paper/fig13-closed-loop.toml", "--rig", &rig, "--out", out.to_str().unwrap()];
    run_bench(&workspace_root(), arguments).assert_exit(0);
    let record = RunRecord::read(&out).unwrap();
    assert!(!record.scenarios.is_empty() && record.scenarios.iter().all(|scenario| scenario.law == "own"));
}

/// Runs `tests/wire.c` with the streams as input. Returns its vectors, then one line per stream.
fn run_wire_program(streams: &[Vec<u8>]) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("wire");
    let compiled = Command::new("cc")
        .args(["-std=c11", "-Wall", "-Wextra", "-Werror", "-o"])
        .arg(&program)
        .args(["protocol.c", "tests/wire.c"].map(|file| starter().join(file)))
        .status()
        .unwrap();
    assert!(compiled.success());
    let mut child = Command::new(&program).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let input: String = streams.iter().map(|stream| hexadecimal(stream, "") + "\n").collect();
    let writer = std::thread::spawn(move || stdin.write_all(input.as_bytes()).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

fn hexadecimal(bytes: &[u8], separator: &str) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(separator)
}

/// Returns description and frame of each documented test vector.
fn documented_vectors() -> Vec<(String, Vec<u8>)> {
    let page = std::fs::read_to_string(workspace_root().join("docs/examples/test-vectors.txt")).unwrap();
    let (mut vectors, mut heading) = (Vec::new(), String::new());
    for line in page.lines() {
        if let Some(frame) = line.strip_prefix("frame ") {
            let bytes = frame.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
            vectors.push((heading.clone(), bytes));
        } else if !line.starts_with("body ") {
            line.clone_into(&mut heading);
        }
    }
    vectors
}

/// Returns the result of the bench's decoder in the format of `tests/wire.c`.
fn expected_line(stream: &[u8]) -> String {
    let (mut reader, mut line) = (FrameReader::new(), String::new());
    for &byte in stream {
        let Some(frame) = reader.push(byte) else { continue };
        match frame.ok().and_then(|body| Some((body[0] & 0x0f, Packet::decode(body).ok()?))) {
            Some((kind, packet)) => write!(line, " [{kind} {}{}]", packet.sequence, values(&packet.message)).unwrap(),
            None => line.push_str(" rejected"),
        }
    }
    line
}

fn values(message: &Message) -> String {
    let words = match message {
        Message::Sample(Sample { time_us, setpoint_um, wd_um, wq_um }) => {
            vec![*time_us, setpoint_um.to_bits(), wd_um.to_bits(), wq_um.to_bits()]
        }
        Message::Configure(configure) => configure_words(configure),
        _ => Vec::new(),
    };
    words.iter().map(|word| format!(" {word:x}")).collect::<Vec<_>>().concat()
}

fn configure_words(configure: &Configure) -> Vec<u32> {
    let none = Gains { amplitude_kp: 0.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };
    let gains = configure.gains.unwrap_or(none);
    let bits =
        [configure.gains.is_some(), configure.paced_by_target, configure.loop_delay_us > 0, configure.drives_own_plate];
    let bits = bits.iter().enumerate().map(|(bit, &is_set)| u32::from(is_set) << bit).sum();
    let floats = [
        configure.gain_um_per_vpp,
        configure.time_constant_s,
        configure.response_time_s,
        configure.drive_limit_vpp,
        configure.frequency_range_hz,
        configure.frequency_slew_hz,
        gains.amplitude_kp,
        gains.amplitude_ki,
        gains.frequency_kp,
        gains.frequency_ki,
    ];
    let mut words = vec![
        configure.law as u32,
        bits,
        u32::from(configure.watchdog_timeout_ms),
        configure.period_us,
        configure.start_frequency_mhz,
    ];
    words.extend(floats.map(f32::to_bits));
    words.push(configure.loop_delay_us);
    words
}

/// Returns `frame` intact, repeated, and damaged: a bit flipped, or a byte inserted or removed.
fn damaged_streams(frame: &[u8]) -> Vec<Vec<u8>> {
    let mut streams = vec![frame.to_vec(), [frame, frame].concat(), [&[0, 0], frame].concat()];
    for at in 0..frame.len() {
        for bit in 0..8 {
            let mut flipped = frame.to_vec();
            flipped[at] ^= 1 << bit;
            // A valid frame follows: the reader must find it after a damaged one.
            streams.push([&flipped, frame].concat());
        }
        let without = [&frame[..at], &frame[at + 1..], frame].concat();
        let with = [&frame[..at], &[7], &frame[at..], frame].concat();
        streams.extend([without, with]);
    }
    let overlong = [&[1; 71][..], &[0], frame].concat();
    streams.push(overlong);
    streams
}

/// Returns frames with a correct CRC but a wrong body: its length or one byte is changed.
fn invalid_bodies(frame: &[u8]) -> Vec<Vec<u8>> {
    let mut reader = FrameReader::new();
    let body = reader.read(&mut &*frame).unwrap().unwrap().to_vec();
    let mut bodies = vec![body[..body.len() - 1].to_vec(), [&body[..], &[0]].concat()];
    for at in 0..body.len() {
        for value in [0, 1, 4, 9, 16, 0x31, 255] {
            let mut changed = body.clone();
            changed[at] = value;
            bodies.push(changed);
        }
    }
    let frames = bodies.iter().map(|body| platebench_wire::EncodedFrame::new(body).unwrap().as_bytes().to_vec());
    frames.collect()
}

#[test]
fn the_c_protocol_agrees_with_the_documented_vectors() {
    let vectors = documented_vectors();
    assert_eq!(vectors.len(), 15);
    let streams: Vec<Vec<u8>> =
        vectors.iter().flat_map(|(_, frame)| [damaged_streams(frame), invalid_bodies(frame)].concat()).collect();
    let lines = run_wire_program(&streams);
    let (encoded, decoded) = lines.split_at(5);
    for (line, heading) in encoded.iter().zip([
        "identity, answering it: version",
        "configured, answering it: accepted",
        "command, answering it: 1234",
        "command, answering it: 2234",
        "fault: HardFault",
    ]) {
        let (_, frame) = vectors.iter().find(|(vector, _)| vector.starts_with(heading)).unwrap();
        assert_eq!(line.split_once(' ').unwrap().1, hexadecimal(frame, " "), "{heading}");
    }
    assert_eq!(decoded.len(), streams.len());
    for (line, stream) in decoded.iter().zip(&streams) {
        assert_eq!(line, &expected_line(stream), "bytes {}", hexadecimal(stream, " "));
    }
    let rejected = decoded.iter().filter(|line| line.contains("rejected")).count();
    assert!(rejected > decoded.len() / 2, "{rejected} of {}", decoded.len());
}
