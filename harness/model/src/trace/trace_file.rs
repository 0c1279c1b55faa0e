//! Defines the rows of a trace, and reads and writes traces.

use crate::files::{FileError, OutputFile, OutputFolder, open_regular_file};
use sha2::{Digest, Sha256};
use std::fs::File;
use std::io;
use std::io::Write;
use std::path::{Path, PathBuf};

bitflags::bitflags! {
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub struct Flags: u8 {
        /// The row is a control instant. The controller received this state as a sample.
        const CONTROL = 1;
        /// The drive is at the amplifier's limit.
        const SATURATED = 1 << 1;
        /// The bench reached this control instant too late.
        const OVERRUN = 1 << 2;
        /// A reply of the controller is missing, so the last drive continues.
        const LINK_LOST = 1 << 3;
        /// The controller has stopped, and the drive is 0 V.
        const SAFE = 1 << 4;
        /// Row of a real plate: amplitudes are from its sensor, unmeasured quantities are empty.
        const SENSED = 1 << 5;
    }
}

const NAMES: [(Flags, &str); 6] = [
    (Flags::CONTROL, "control"),
    (Flags::SATURATED, "saturated"),
    (Flags::OVERRUN, "overrun"),
    (Flags::LINK_LOST, "link-lost"),
    (Flags::SAFE, "safe"),
    (Flags::SENSED, "sensed"),
];

impl Flags {
    pub(crate) fn names(self) -> impl Iterator<Item = &'static str> {
        NAMES.iter().filter(move |(flag, _)| self.contains(*flag)).map(|(_, name)| *name)
    }

    /// On failure, the error is the unknown name.
    pub(crate) fn parse(text: &str) -> Result<Self, &str> {
        text.split('|').filter(|name| !name.is_empty()).try_fold(Self::empty(), |flags, name| {
            NAMES.iter().find(|(_, known)| *known == name).map(|(flag, _)| flags | *flag).ok_or(name)
        })
    }
}

macro_rules! define_row {
    ($($(#[$doc:meta])* $variant:ident $column:ident,)+) => {
        /// The state of a trial at an instant. Amplitudes and voltages are peak to peak.
        #[derive(Debug, Clone, Copy, PartialEq, Default)]
        pub struct Row {
            $($(#[$doc])* pub $column: f64,)+
            pub flags: Flags,
        }

        pub const COLUMNS: [&str; NUMBERS + 1] = [$(stringify!($column),)+ "flags"];

        /// Numbers of a row, in the order of [`COLUMNS`] without `flags`.
        pub(crate) const NUMBERS: usize = [$(stringify!($column)),+].len();

        /// A column with a number.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum Column {
            $($variant,)+
        }

        impl Column {
            pub const ALL: [Self; NUMBERS] = [$(Self::$variant),+];

            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => stringify!($column),)+
                }
            }

            pub const fn value(self, row: &Row) -> f64 {
                match self {
                    $(Self::$variant => row.$column,)+
                }
            }

            pub fn from_name(name: &str) -> Option<Self> {
                Self::ALL.into_iter().find(|column| column.name() == name)
            }
        }

        impl Row {
            pub(crate) const fn numbers(&self) -> [f64; NUMBERS] {
                [$(self.$column),+]
            }

            pub(crate) const fn from_numbers([$($column),+]: [f64; NUMBERS], flags: Flags) -> Self {
                Self { $($column,)+ flags }
            }
        }
    };
}

define_row! {
    Time t_s,
    Setpoint setpoint_um,
    /// In-phase component of W.
    Wd wd_um,
    /// Quadrature component of W.
    Wq wq_um,
    Amplitude amplitude_um,
    Drive drive_vpp,
    Frequency frequency_hz,
    /// The plate's true resonance ω0/2π; NaN, and empty in the file, if unknown.
    Resonance resonance_hz,
    /// Kelvin above the plate's reference temperature; NaN, and empty in the file, if not measured.
    Temperature temperature_offset_k,
    /// Normal force of the finger, N; NaN, and empty in the file, if not measured.
    Force finger_force_n,
    /// In-phase component that the controller received last, with the sensor's errors.
    SensedWd sensed_wd_um,
    /// Quadrature component that the controller received last, with the sensor's errors.
    SensedWq sensed_wq_um,
    Lateness lateness_us,
}

/// Columns that may be empty in a row with the flag `sensed`.
pub const OPTIONAL_COLUMNS: [Column; 3] = [Column::Resonance, Column::Temperature, Column::Force];

/// Largest size of a trace that is read: 4 GiB, about 10⁷ rows.
const MAX_BYTES: u64 = 4 << 30;
const BUFFER_BYTES: usize = 64 << 10;
/// Largest row: 13 numbers of at most 24 characters, every flag, separators.
const MAX_ROW_BYTES: usize = 400;

#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    #[error("{}:{line}: {message}", path.display())]
    Content {
        path: PathBuf,
        /// Line number, counted from 1.
        line: u64,
        message: String,
    },
}

impl From<FileError> for TraceError {
    fn from(FileError { path, source }: FileError) -> Self {
        Self::Io { path, source }
    }
}

/// The file gets its name in [`TraceWriter::finish`], so a file with this name is complete.
#[derive(Debug)]
pub struct TraceWriter {
    file: OutputFile,
    hash: Sha256,
    buffer: Vec<u8>,
    /// Numbers of the last row as text. Most numbers repeat and are formatted only once.
    cells: [Cell; NUMBERS],
    path: PathBuf,
}

#[derive(Debug)]
struct Cell {
    value: f64,
    text: String,
}

impl Cell {
    /// The text for NaN is an empty field.
    fn new() -> Self {
        Self { value: f64::NAN, text: String::new() }
    }

    fn update(&mut self, value: f64) {
        if self.value.to_bits() == value.to_bits() {
            return;
        }
        self.value = value;
        self.text.clear();
        let mut digits = zmij::Buffer::new();
        match value.abs() {
            ..1e16 => self.text.push_str(digits.format_finite(value)),
            // The format has no plus sign in an exponent.
            1e16.. => self.text.extend(digits.format(value).split('+')),
            _ => {}
        }
    }
}

impl TraceWriter {
    /// Creates the trace at `path`. Its folder must exist. Replaces a link at `path`.
    pub fn create(path: &Path) -> Result<Self, TraceError> {
        Ok(Self::new(OutputFile::create(path)?, path.to_owned()))
    }

    pub fn create_in(folder: &OutputFolder, relative: impl AsRef<Path>) -> Result<Self, TraceError> {
        let path = folder.path().join(&relative);
        Ok(Self::new(folder.create_file(relative)?, path))
    }

    fn new(file: OutputFile, path: PathBuf) -> Self {
        let mut buffer = Vec::with_capacity(BUFFER_BYTES + MAX_ROW_BYTES);
        buffer.extend_from_slice(COLUMNS.join(",").as_bytes());
        buffer.push(b'\n');
        let cells = std::array::from_fn(|_| Cell::new());
        Self { file, hash: Sha256::new(), buffer, cells, path }
    }

    pub fn write(&mut self, row: &Row) -> Result<(), TraceError> {
        for (cell, value) in self.cells.iter_mut().zip(row.numbers()) {
            cell.update(value);
            self.buffer.extend_from_slice(cell.text.as_bytes());
            self.buffer.push(b',');
        }
        for (place, name) in row.flags.names().enumerate() {
            self.buffer.extend_from_slice(if place > 0 { b"|" } else { b"" });
            self.buffer.extend_from_slice(name.as_bytes());
        }
        self.buffer.push(b'\n');
        if self.buffer.len() < BUFFER_BYTES { Ok(()) } else { self.flush() }
    }

    fn flush(&mut self) -> Result<(), TraceError> {
        self.hash.update(&self.buffer);
        self.file.write_all(&self.buffer).map_err(|source| TraceError::Io { path: self.path.clone(), source })?;
        self.buffer.clear();
        Ok(())
    }

    /// Gives the trace its final name and returns its SHA-256.
    pub fn finish(mut self) -> Result<[u8; 32], TraceError> {
        self.flush()?;
        // `run.json` contains the hash of every trace, which reveals damage by a power cut.
        self.file.commit_without_sync()?;
        Ok(self.hash.finalize().into())
    }
}

/// Reads one row at a time, so the memory does not grow with the file. The iterator ends after an
/// error. A trace without rows gives an error.
#[derive(Debug)]
pub struct TraceReader {
    reader: csv::Reader<io::Take<File>>,
    record: csv::ByteRecord,
    /// The row above. Most cells repeat and are parsed only once.
    above: csv::ByteRecord,
    numbers: [f64; NUMBERS],
    path: PathBuf,
    previous_t_s: Option<f64>,
    finished: bool,
}

impl TraceReader {
    /// Fails if the file cannot be opened or has other columns.
    pub fn open(path: &Path) -> Result<Self, TraceError> {
        let file =
            open_regular_file(path, MAX_BYTES).map_err(|source| TraceError::Io { path: path.to_owned(), source })?;
        let reader = csv::Reader::from_reader(file);
        let mut rows = Self {
            reader,
            record: csv::ByteRecord::new(),
            above: csv::ByteRecord::new(),
            numbers: [f64::NAN; NUMBERS],
            path: path.to_owned(),
            previous_t_s: None,
            finished: false,
        };
        let header = rows.reader.headers().cloned().map_err(|error| rows.csv_error(&error))?;
        if header.iter().ne(COLUMNS) {
            let found = header.iter().collect::<Vec<_>>().join(",");
            return Err(rows.content_error(1, format!("columns `{found}`, expected `{}`", COLUMNS.join(","))));
        }
        Ok(rows)
    }

    fn content_error(&self, line: u64, message: String) -> TraceError {
        TraceError::Content { path: self.path.clone(), line, message }
    }

    fn csv_error(&self, error: &csv::Error) -> TraceError {
        match error.kind() {
            csv::ErrorKind::Io(io_error) => {
                TraceError::Io { path: self.path.clone(), source: io::Error::new(io_error.kind(), error.to_string()) }
            }
            _ => self.content_error(error.position().map_or(1, csv::Position::line), error.to_string()),
        }
    }

    fn read_row(&mut self) -> Result<Option<Row>, TraceError> {
        std::mem::swap(&mut self.record, &mut self.above);
        if !self.reader.read_byte_record(&mut self.record).map_err(|error| self.csv_error(&error))? {
            return if self.previous_t_s.is_some() {
                Ok(None)
            } else {
                Err(self.content_error(2, "no rows, expected at least one".to_owned()))
            };
        }
        let line = self.record.position().map_or(0, csv::Position::line);
        let text = String::from_utf8_lossy(self.record.get(NUMBERS).unwrap_or_default());
        let flags = Flags::parse(&text).map_err(|name| {
            self.content_error(
                line,
                format!(
                    "unknown flag `{name}`, expected a |-separated set of control, saturated, overrun, link-lost, \
                         safe, sensed"
                ),
            )
        })?;
        let mut numbers = self.numbers;
        for ((place, column), number) in Column::ALL.into_iter().enumerate().zip(&mut numbers) {
            let cell = self.record.get(place).unwrap_or_default();
            if cell.is_empty() && flags.contains(Flags::SENSED) && OPTIONAL_COLUMNS.contains(&column) {
                *number = f64::NAN;
            } else if cell.is_empty() || self.above.get(place) != Some(cell) {
                let text = String::from_utf8_lossy(cell);
                let parsed = text.parse().ok().filter(|value: &f64| value.is_finite());
                *number = parsed.ok_or_else(|| {
                    self.content_error(line, format!("`{}` is `{text}`, expected a finite number", column.name()))
                })?;
            }
        }
        self.numbers = numbers;
        let row = Row::from_numbers(numbers, flags);
        if self.previous_t_s.is_some_and(|before| before > row.t_s) {
            let message = format!("`t_s` is {}, expected a time that is not before the previous row", row.t_s);
            return Err(self.content_error(line, message));
        }
        self.previous_t_s = Some(row.t_s);
        Ok(Some(row))
    }
}

impl Iterator for TraceReader {
    type Item = Result<Row, TraceError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.finished {
            return None;
        }
        let row = self.read_row().transpose();
        self.finished = !matches!(row, Some(Ok(_)));
        row
    }
}

/// Fails without rows, for decreasing times and for numbers that are not finite.
pub fn read_trace(path: &Path) -> Result<Vec<Row>, TraceError> {
    TraceReader::open(path)?.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::trace_file::Flags;
    use proptest::prelude::*;
    use std::fs;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn temp_path() -> PathBuf {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        std::env::temp_dir().join(format!("platebench-trace-{}-{number}.csv", std::process::id()))
    }

    fn round_trip(rows: &[Row]) -> (String, Vec<Row>) {
        let path = temp_path();
        let mut writer = TraceWriter::create(&path).unwrap();
        for row in rows {
            writer.write(row).unwrap();
        }
        assert!(!path.exists(), "not under its final name before it is whole");
        writer.finish().unwrap();
        let result = (fs::read_to_string(&path).unwrap(), read_trace(&path).unwrap());
        fs::remove_file(&path).unwrap();
        result
    }

    fn read_error(text: &str) -> String {
        let path = temp_path();
        fs::write(&path, text).unwrap();
        let error = read_trace(&path).unwrap_err().to_string();
        fs::remove_file(&path).unwrap();
        error.rsplit_once(".csv").unwrap().1.to_owned()
    }

    #[test]
    fn writes_the_documented_layout() {
        let row = Row {
            t_s: 0.00105,
            setpoint_um: 2.0,
            wq_um: -1e-9,
            drive_vpp: 551.25,
            flags: Flags::CONTROL | Flags::LINK_LOST,
            ..Row::default()
        };
        let (text, _) = round_trip(&[row, Row { t_s: 1.0, ..Row::default() }]);
        assert_eq!(
            text,
            "t_s,setpoint_um,wd_um,wq_um,amplitude_um,drive_vpp,frequency_hz,resonance_hz,temperature_offset_k,\
             finger_force_n,sensed_wd_um,sensed_wq_um,lateness_us,flags\n\
             0.00105,2.0,0.0,-1e-9,0.0,551.25,0.0,0.0,0.0,0.0,0.0,0.0,0.0,control|link-lost\n\
             1.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,\n"
        );
    }

    #[test]
    fn rejects_invalid_traces_with_their_line() {
        let header = COLUMNS.join(",");
        let zeros = "0,0,0,0,0,0,0,0,0,0,0,0,0,";
        assert!(read_error("").starts_with(":1: columns ``, expected `t_s,"));
        assert!(read_error(&format!("{}\n", header.replace("wq_um", "w_q"))).starts_with(":1: columns `t_s,"));
        assert!(read_error(&format!("{header}\n")).starts_with(":2: no rows"));
        assert!(read_error(&format!("{header}\n{zeros}\n0,0\n")).starts_with(":3: "));
        assert!(read_error(&format!("{header}\n{zeros}\n0,x{zeros}\n")).starts_with(":3: "));
        assert!(
            read_error(&format!("{header}\n0,NaN,0,0,0,0,0,0,0,0,0,0,0,\n")).contains(":2: `setpoint_um` is `NaN`")
        );
        assert!(read_error(&format!("{header}\n{zeros}late\n")).contains("unknown flag `late`"));
        // Cells that repeat those of the row above are valid only if empty ones are.
        let unknown = "0,0,0,0,0,0,0,,,,0,0,0,";
        let repeated = format!("{header}\n{unknown}sensed\n{unknown}sensed\n{unknown}\n");
        assert!(read_error(&repeated).contains(":4: `resonance_hz` is ``, expected a finite number"));
        let known = format!("{header}\n{zeros}\n{}\n", zeros.replacen("0,0,", "0,0x,", 1));
        assert!(read_error(&known).contains(":3: `setpoint_um` is `0x`"));
        assert!(read_error(&format!("{header}\n1{zeros}\n{zeros}\n").replace("10,", "1,")).contains(":3: `t_s` is 0"));
        assert!(
            read_trace(Path::new("/no/such/trace.csv")).unwrap_err().to_string().starts_with("/no/such/trace.csv: ")
        );
    }

    #[test]
    fn allows_empty_numbers_in_rows_of_a_real_plate_only() {
        let row = Row {
            wd_um: 2.0,
            resonance_hz: f64::NAN,
            temperature_offset_k: f64::NAN,
            finger_force_n: f64::NAN,
            flags: Flags::CONTROL | Flags::SENSED,
            ..Row::default()
        };
        let (text, rows) = round_trip(&[row, Row { finger_force_n: 0.5, ..row }]);
        assert!(text.contains("\n0.0,0.0,2.0,0.0,0.0,0.0,0.0,,,,0.0,0.0,0.0,control|sensed\n"), "{text}");
        assert!(rows[0].resonance_hz.is_nan() && rows[0].temperature_offset_k.is_nan());
        assert!(rows[0].finger_force_n.is_nan() && rows[1].finger_force_n == 0.5);
        let header = COLUMNS.join(",");
        assert!(
            read_error(&format!("{header}\n0,0,0,0,0,0,0,,0,0,0,0,0,\n")).contains("`resonance_hz` is ``, expected")
        );
        assert!(read_error(&format!("{header}\n0,0,0,,0,0,0,0,0,0,0,0,0,sensed\n")).starts_with(":2: "));
        assert!(read_error(&format!("{header}\n0,0,0,0,0,0,0,NaN,0,0,0,0,0,sensed\n")).contains("is `NaN`, expected"));
    }

    fn csv_line(numbers: [f64; NUMBERS]) -> String {
        let mut writer = csv::Writer::from_writer(Vec::new());
        writer.serialize(numbers).unwrap();
        String::from_utf8(writer.into_inner().unwrap()).unwrap()
    }

    #[test]
    fn returns_the_hash_of_the_whole_file() {
        let path = temp_path();
        let mut writer = TraceWriter::create(&path).unwrap();
        let rows = (0..3_000).map(|n| Row { t_s: f64::from(n) / 3.0, ..Row::default() });
        rows.for_each(|row| writer.write(&row).unwrap());
        let hash = writer.finish().unwrap();
        let bytes = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        assert!(bytes.len() > BUFFER_BYTES);
        assert_eq!(hash, <[u8; 32]>::from(Sha256::digest(&bytes)));
    }

    proptest! {
        #[test]
        fn a_number_has_the_shortest_text(values in proptest::array::uniform13(prop_oneof![
            any::<f64>().prop_filter("not NaN", |value| !value.is_nan()),
            (-1_000_000_i32..1_000_000, -14_i32..18).prop_map(|(digits, power)| f64::from(digits) * 10_f64.powi(power)),
            any::<f32>().prop_filter("not NaN", |value| !value.is_nan()).prop_map(f64::from),
        ])) {
            let mut cell = Cell::new();
            let texts = values.map(|value| { cell.update(value); cell.text.clone() });
            prop_assert_eq!(texts.join(",") + "\n", csv_line(values));
        }

        #[test]
        fn every_double_round_trips(
            bits in proptest::collection::vec(any::<f64>().prop_filter("finite", |x| x.is_finite()), 12),
            flags in 0_u8..64,
        ) {
            let row = Row {
                t_s: 0.0, setpoint_um: bits[0], wd_um: bits[1], wq_um: bits[2], amplitude_um: bits[3],
                drive_vpp: bits[4], frequency_hz: bits[5], resonance_hz: bits[6], temperature_offset_k: bits[7],
                finger_force_n: bits[8], sensed_wd_um: bits[9], sensed_wq_um: bits[10], lateness_us: bits[11],
                flags: Flags::from_bits_truncate(flags),
            };
            prop_assert_eq!(round_trip(&[row]).1, [row]);
        }
    }
}
