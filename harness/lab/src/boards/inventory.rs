//! Reads and checks `boards.toml`. Defines the errors of boards.

use jiff::civil::Date;
use platebench_model::scenario::{Diagnostic, FileChecker, find_trusted_file_above};
use platebench_model::trace::FileError;
use platebench_rig::{ConnectError, LockHolder, RigError, RigSpec};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize, Serializer};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

pub const INVENTORY_FILE: &str = "boards.toml";
const CHIP_ID_DIGITS: usize = 24;
const MAX_NAME_LENGTH: usize = 64;

/// Boards of a lab.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawInventory {
    /// Boards.
    #[schemars(length(min = 1))]
    board: Vec<RawBoard>,
}

/// `[[board]]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawBoard {
    /// Unique name: letters, digits, `.`, `_` and `-`; the first is a letter or a digit.
    #[schemars(regex(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"))]
    name: String,
    /// The rig of the controller, as `--rig`.
    #[schemars(length(min = 1))]
    rig: String,
    /// Computer that the board is connected to.
    host: Option<String>,
    /// Number of the chip, 24 hexadecimal digits. A board with another chip is rejected before it
    /// gets a voltage.
    #[schemars(regex(pattern = "^[0-9A-Fa-f]{24}$"))]
    chip_id: Option<String>,
    /// Serial number of the debug probe. Two boards with the same probe are never in use at the
    /// same time.
    #[schemars(length(min = 1))]
    probe_serial: Option<String>,
    /// Amplifier.
    amplifier: Option<String>,
    /// Plate file, relative to this file.
    plate: Option<PathBuf>,
    /// Sensor.
    sensor: Option<RawBoardSensor>,
}

/// `[board.sensor]`
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawBoardSensor {
    /// Type and serial number.
    name: String,
    /// Date of the calibration, YYYY-MM-DD.
    #[schemars(regex(pattern = "^[0-9]{4}-[0-9]{2}-[0-9]{2}$"))]
    calibrated: Option<String>,
    /// Standard uncertainty of the sensor's gain, %.
    #[schemars(range(min = 0.0))]
    uncertainty_percent: Option<f64>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Board {
    pub name: String,
    #[serde(serialize_with = "serialize_rig")]
    #[schemars(with = "String")]
    pub rig: RigSpec,
    pub host: Option<String>,
    /// Hexadecimal digits in lower case.
    pub chip_id: Option<String>,
    pub probe_serial: Option<String>,
    pub amplifier: Option<String>,
    pub plate: Option<PathBuf>,
    pub sensor: Option<BoardSensor>,
}

fn serialize_rig<S: Serializer>(rig: &RigSpec, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(rig)
}

impl Board {
    pub fn describe_instruments(&self) -> String {
        let mut text = format!("board {}", self.name);
        let amplifier = self.amplifier.iter().map(|amplifier| format!(", amplifier {amplifier}"));
        let sensor = self.sensor.iter().map(|sensor| format!(", sensor {}", sensor.describe()));
        text.extend(amplifier.chain(sensor));
        text
    }
}

impl BoardSensor {
    fn describe(&self) -> String {
        let calibrated = self.calibrated.iter().map(|date| format!(" calibrated {date}"));
        let uncertainty = self.uncertainty_percent.iter().map(|percent| format!(" uncertainty {percent} %"));
        std::iter::once(self.name.clone()).chain(calibrated).chain(uncertainty).collect()
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct BoardSensor {
    pub name: String,
    pub calibrated: Option<String>,
    pub uncertainty_percent: Option<f64>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Inventory {
    pub path: PathBuf,
    pub boards: Vec<Board>,
}

impl Inventory {
    /// Reads `file`, or the nearest `boards.toml` from the working directory upwards.
    pub fn open(file: Option<&Path>) -> Result<Self, BoardError> {
        if let Some(file) = file {
            return Self::read(file).map_err(BoardError::Inventory);
        }
        let folder = std::env::current_dir().map_err(|_| BoardError::NoInventory)?;
        let nearest = find_trusted_file_above(&folder, INVENTORY_FILE, "--boards");
        let path = nearest.map_err(|problem| BoardError::Inventory(vec![problem]))?.ok_or(BoardError::NoInventory)?;
        Self::read(&path).map_err(BoardError::Inventory)
    }

    pub fn read(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let (mut checker, raw) = FileChecker::read::<RawInventory>(path)?;
        let mut names = BTreeSet::new();
        let mut boards = Vec::new();
        checker.require(!raw.board.is_empty(), "board", || "no board, expected at least one [[board]]".to_owned());
        for (index, board) in raw.board.into_iter().enumerate() {
            let mut refuse = |key: &str, why: String| checker.report(&format!("board.{index}.{key}"), why);
            if !names.insert(board.name.clone()) {
                refuse("name", format!("`{}` is the name of an earlier board, expected another one", board.name));
            }
            if let Some(checked) = board.check(path, &mut refuse) {
                boards.push(checked);
            }
        }
        checker.finish().map(|_| Self { path: path.to_owned(), boards })
    }

    pub fn board(&self, name: &str) -> Result<&Board, BoardError> {
        self.boards.iter().find(|board| board.name == name).ok_or_else(|| BoardError::Unknown {
            path: self.path.clone(),
            name: name.to_owned(),
            known: self.names(),
        })
    }

    /// The names of the boards: "left, right".
    pub fn names(&self) -> String {
        self.boards.iter().map(|board| board.name.as_str()).collect::<Vec<_>>().join(", ")
    }

    /// Folder of locks and states, for example `boards.state` next to `boards.toml`.
    pub(crate) fn state_folder(&self) -> PathBuf {
        self.path.with_extension("state")
    }
}

impl RawBoard {
    fn check(self, path: &Path, refuse: &mut dyn FnMut(&str, String)) -> Option<Board> {
        let is_inner = |byte: u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'_' | b'-');
        let is_name = self.name.len() <= MAX_NAME_LENGTH
            && self.name.bytes().all(is_inner)
            && self.name.bytes().next().is_some_and(|byte| byte.is_ascii_alphanumeric());
        if !is_name {
            let rule = "expected letters, digits, `.`, `_` or `-`, at most 64, the first a letter or a digit";
            refuse("name", format!("`{}`, {rule}", self.name));
        }
        let rig = self.rig.parse::<RigSpec>().map_err(|error| refuse("rig", error.to_string())).ok();
        let is_digits =
            |text: &String| text.len() == CHIP_ID_DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        if let Some(text) = self.chip_id.as_ref().filter(|text| !is_digits(text)) {
            refuse("chip_id", format!("`{text}`, expected {CHIP_ID_DIGITS} hexadecimal digits"));
        }
        if self.probe_serial.as_ref().is_some_and(String::is_empty) {
            refuse("probe_serial", "empty, expected a serial number".to_owned());
        }
        let folder = path.parent().unwrap_or(Path::new(""));
        let plate = self.plate.map(|plate| folder.join(plate));
        if let Some(plate) = plate.as_ref().filter(|plate| !plate.is_file()) {
            refuse("plate", format!("{}: no such file, expected a plate file", plate.display()));
        }
        let sensor = self.sensor.map(|sensor| sensor.check(refuse));
        Some(Board {
            name: self.name,
            rig: rig?,
            host: self.host,
            chip_id: self.chip_id.map(|text| text.to_ascii_lowercase()),
            probe_serial: self.probe_serial,
            amplifier: self.amplifier,
            plate,
            sensor,
        })
    }
}

impl RawBoardSensor {
    fn check(self, refuse: &mut dyn FnMut(&str, String)) -> BoardSensor {
        if let Some(text) = self.calibrated.as_ref().filter(|text| text.parse::<Date>().is_err()) {
            refuse("sensor.calibrated", format!("`{text}`, expected a date YYYY-MM-DD"));
        }
        let Self { name, calibrated, uncertainty_percent } = self;
        BoardSensor { name, calibrated, uncertainty_percent }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Inventory(Vec<Diagnostic>),
    #[error("no boards.toml in this folder or a folder above it, expected this file or --boards FILE")]
    NoInventory,
    #[error("{}: no board `{name}`, expected one of {known}", path.display())]
    Unknown { path: PathBuf, name: String, known: String },
    #[error(transparent)]
    File(#[from] FileError),
    #[error(
        "{}: the file is damaged: {source}; expected the state of the board as platebench wrote it",
        path.display()
    )]
    State { path: PathBuf, source: serde_json::Error },
    #[error("board {name} is held by {holder}{since}; --wait SECONDS waits for it")]
    Held {
        name: String,
        holder: LockHolder,
        /// Text ` since TIME` with the start of the reservation, or empty if it is unknown.
        since: String,
    },
    #[error(
        "board {name} is in quarantine since {since}: {reason}; check it, then: platebench board clear {name} \
         --reason TEXT"
    )]
    Quarantined { name: String, since: String, reason: String },
    #[error("board {name} is not in quarantine")]
    NotQuarantined { name: String },
    #[error("--reason is empty, expected a text that states what was checked on the board")]
    NoReason,
    #[error(
        "board {name}: the connected chip has the number {found}, boards.toml has {expected}; connect the right board \
         or correct boards.toml"
    )]
    WrongChip { name: String, found: String, expected: String },
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error("cancelled while waiting for board {0}")]
    Cancelled(String),
}

impl BoardError {
    /// True if the input is wrong, false if the board cannot be used now.
    pub fn is_invalid_input(&self) -> bool {
        match self {
            Self::Inventory(_)
            | Self::NoInventory
            | Self::Unknown { .. }
            | Self::File(_)
            | Self::State { .. }
            | Self::NotQuarantined { .. }
            | Self::NoReason => true,
            Self::Connect(error) => error.is_invalid_input(),
            Self::Held { .. }
            | Self::Quarantined { .. }
            | Self::WrongChip { .. }
            | Self::Rig(_)
            | Self::Cancelled(_) => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Inventory, Vec<String>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("boards.toml");
        std::fs::write(&path, text).unwrap();
        let describe = |problem: &Diagnostic| format!("{}: {}", problem.position().0, problem.message);
        Inventory::read(&path).map_err(|problems| problems.iter().map(describe).collect())
    }

    #[test]
    fn reads_every_key() {
        let inventory = read(
            "[[board]]\nname = \"a\"\nrig = \"serial:/dev/ttyACM0@1000000\"\nhost = \"lab\"\n\
             chip_id = \"00112233445566778899AABB\"\nprobe_serial = \"066D\"\namplifier = \"HVA 900\"\n\
             [board.sensor]\nname = \"vibrometer\"\ncalibrated = \"2026-01-31\"\nuncertainty_percent = 0.4\n\
             [[board]]\nname = \"b\"\nrig = \"emulated\"\n",
        )
        .unwrap();
        let first = inventory.board("a").unwrap();
        assert_eq!(first.chip_id.as_deref(), Some("00112233445566778899aabb"));
        assert_eq!(first.sensor.as_ref().and_then(|sensor| sensor.uncertainty_percent), Some(0.4));
        assert_eq!(inventory.board("b").unwrap().rig, RigSpec::emulated(None));
        let unknown = inventory.board("c").unwrap_err();
        assert!(unknown.to_string().contains("expected one of a, b"), "{unknown}");
    }

    #[test]
    fn reports_every_problem_with_its_line() {
        let problems = read(
            "[[board]]\nname = \"../a\"\nrig = \"can:0\"\nchip_id = \"12\"\nplate = \"none.toml\"\n\
             [board.sensor]\nname = \"x\"\ncalibrated = \"2026-02-30\"\nuncertainty_percent = 1.0\n\
             [[board]]\nname = \"b\"\nrig = \"hosted\"\n[[board]]\nname = \"b\"\nrig = \"hosted\"\n",
        )
        .unwrap_err();
        let lines: Vec<_> = problems.iter().map(|problem| problem.split(':').next().unwrap()).collect();
        assert_eq!(lines, ["2", "3", "4", "5", "8", "14"], "{problems:#?}");
        let sensor =
            "[[board]]\nname = \"a\"\nrig = \"hosted\"\n[board.sensor]\nname = \"x\"\nuncertainty_percent = -1.0\n";
        assert_eq!(read(sensor).unwrap_err(), ["6: `uncertainty_percent`: -1 %, expected 0 or more"]);
        assert!(read("[[board]]\nname = \"a\"\nrig = \"hosted\"\nrigg = 1\n").unwrap_err()[0].contains("rigg"));
        assert!(read("").is_err() && read("board = []\n").is_err());
    }
}
