//! Reads and writes trace files.

use crate::atomic_file::AtomicFile;
use crate::regular_file::open_regular_file;
use crate::row::{COLUMNS, Flags, OPTIONAL_COLUMNS, Row};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

/// 4 GiB, some 10⁷ rows.
const MAX_BYTES: u64 = 4 << 30;

#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    #[error("{}: {source}", path.display())]
    Io {
        /// The trace.
        path: PathBuf,
        source: io::Error,
    },
    #[error("{}:{line}: {message}", path.display())]
    Content {
        path: PathBuf,
        /// Counted from 1.
        line: u64,
        message: String,
    },
}

/// The file gets its name in [`TraceWriter::finish`], so a file of that name is complete.
#[derive(Debug)]
pub struct TraceWriter {
    rows: csv::Writer<AtomicFile>,
    path: PathBuf,
}

impl TraceWriter {
    /// Starts the trace at `path`. Its folder must exist.
    pub fn create(path: &Path) -> Result<Self, TraceError> {
        let file = AtomicFile::create(path).map_err(|source| TraceError::Io { path: path.to_owned(), source })?;
        Ok(Self { rows: csv::Writer::from_writer(file), path: path.to_owned() })
    }

    pub fn write(&mut self, row: &Row) -> Result<(), TraceError> {
        self.rows.serialize(row).map_err(|error| self.io_error(error.into()))
    }

    /// Gives the trace its final name.
    pub fn finish(self) -> Result<(), TraceError> {
        let path = self.path;
        // The record holds the hash of every trace, so a power cut does not go unnoticed.
        let written =
            self.rows.into_inner().map_err(csv::IntoInnerError::into_error).and_then(AtomicFile::commit_without_sync);
        written.map_err(|source| TraceError::Io { path, source })
    }

    fn io_error(&self, source: io::Error) -> TraceError {
        TraceError::Io { path: self.path.clone(), source }
    }
}

/// Reads and checks the rows one by one, so memory does not grow with the trace. A trace without
/// rows gives one error. The iterator ends after an error.
#[derive(Debug)]
pub struct TraceReader {
    reader: csv::Reader<io::Take<File>>,
    record: csv::StringRecord,
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
            record: csv::StringRecord::new(),
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
        if !self.reader.read_record(&mut self.record).map_err(|error| self.csv_error(&error))? {
            return if self.previous_t_s.is_some() {
                Ok(None)
            } else {
                Err(self.content_error(2, "no rows, expected at least one".to_owned()))
            };
        }
        let line = self.record.position().map_or(0, csv::Position::line);
        let row: Row = self.record.deserialize(None).map_err(|error| self.content_error(line, error.to_string()))?;
        let numbers = self.record.iter().zip(COLUMNS).take(COLUMNS.len() - 1);
        for (text, column) in numbers {
            let may_be_empty = row.flags.contains(Flags::SENSED) && OPTIONAL_COLUMNS.contains(&column);
            if text.is_empty() && may_be_empty {
                continue;
            }
            if !text.parse::<f64>().is_ok_and(f64::is_finite) {
                return Err(self.content_error(line, format!("`{column}` is {text}, expected a finite number")));
            }
        }
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

/// Fails unless there is a row, times do not decrease and every number is finite. Unknown
/// quantities of a real plate are empty.
pub fn read_trace(path: &Path) -> Result<Vec<Row>, TraceError> {
    TraceReader::open(path)?.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::row::Flags;
    use proptest::prelude::*;
    use std::fs;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// A new path for each call.
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
    fn rejects_what_is_not_a_trace_with_its_line() {
        let header = COLUMNS.join(",");
        let zeros = "0,0,0,0,0,0,0,0,0,0,0,0,0,";
        assert!(read_error("").starts_with(":1: columns ``, expected `t_s,"));
        assert!(read_error(&format!("{}\n", header.replace("wq_um", "w_q"))).starts_with(":1: columns `t_s,"));
        assert!(read_error(&format!("{header}\n")).starts_with(":2: no rows"));
        assert!(read_error(&format!("{header}\n{zeros}\n0,0\n")).starts_with(":3: "));
        assert!(read_error(&format!("{header}\n{zeros}\n0,x{zeros}\n")).starts_with(":3: "));
        assert!(read_error(&format!("{header}\n0,NaN,0,0,0,0,0,0,0,0,0,0,0,\n")).contains(":2: `setpoint_um` is NaN"));
        assert!(read_error(&format!("{header}\n{zeros}late\n")).contains("unknown flag `late`"));
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
        assert!(read_error(&format!("{header}\n0,0,0,0,0,0,0,,0,0,0,0,0,\n")).contains("`resonance_hz` is , expected"));
        assert!(read_error(&format!("{header}\n0,0,0,,0,0,0,0,0,0,0,0,0,sensed\n")).starts_with(":2: "));
        assert!(read_error(&format!("{header}\n0,0,0,0,0,0,0,NaN,0,0,0,0,0,sensed\n")).contains("is NaN, expected"));
    }

    proptest! {
        #[test]
        fn every_double_round_trips(bits in proptest::collection::vec(any::<f64>().prop_filter("finite", |x| x.is_finite()), 12), flags in 0_u8..64) {
            let row = Row {
                t_s: 0.0, setpoint_um: bits[0], wd_um: bits[1], wq_um: bits[2], amplitude_um: bits[3], drive_vpp: bits[4],
                frequency_hz: bits[5], resonance_hz: bits[6], temperature_offset_k: bits[7], finger_force_n: bits[8],
                sensed_wd_um: bits[9], sensed_wq_um: bits[10], lateness_us: bits[11], flags: Flags::from_bits_truncate(flags),
            };
            prop_assert_eq!(round_trip(&[row]).1, [row]);
        }
    }
}
