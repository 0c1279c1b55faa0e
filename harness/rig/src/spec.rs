//! `--rig` as a user writes it.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// Which rig to use.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RigSpec {
    /// The controller crate in this process.
    Hosted,
    /// An ELF on an emulated STM32F4; the image that came with the bench where none is named.
    Emulated(Option<PathBuf>),
    /// A program on a pseudo-terminal.
    Exec(String),
    /// A board on a serial port.
    Serial {
        /// Path or name of the port.
        port: String,
        /// Bits per second.
        baud: Option<u32>,
    },
    /// A board on a debug probe: `CHIP[@VID:PID[:SERIAL]]`, read by `probe::ProbeSpec`.
    Probe(String),
}

/// A rig that was not understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}`: {problem}, expected hosted, emulated[:ELF], exec:COMMAND, serial:PORT[@BAUD] or probe:CHIP[@VID:PID[:SERIAL]]"
)]
pub struct SpecError {
    text: String,
    problem: &'static str,
}

impl FromStr for RigSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let refuse = |problem| Err(SpecError { text: text.to_owned(), problem });
        let (kind, rest) = text.split_once(':').map_or((text, None), |(kind, rest)| (kind, Some(rest)));
        match (kind, rest) {
            ("hosted", None) => Ok(Self::Hosted),
            ("emulated", None) => Ok(Self::Emulated(None)),
            (_, Some("")) => refuse("nothing after the colon"),
            ("emulated", Some(elf)) => Ok(Self::Emulated(Some(elf.into()))),
            ("exec", Some(command)) => Ok(Self::Exec(command.to_owned())),
            ("probe", Some(chip)) => Ok(Self::Probe(chip.to_owned())),
            ("serial", Some(rest)) => match rest.rsplit_once('@') {
                None => Ok(Self::Serial { port: rest.to_owned(), baud: None }),
                Some((port, baud)) => match baud.parse() {
                    Ok(baud) if baud > 0 && !port.is_empty() => {
                        Ok(Self::Serial { port: port.to_owned(), baud: Some(baud) })
                    }
                    _ => refuse("no port or no baud rate"),
                },
            },
            ("exec" | "serial" | "probe", None) => refuse("something is missing after the kind"),
            ("hosted", Some(_)) => refuse("the hosted rig takes nothing"),
            _ => refuse("unknown kind"),
        }
    }
}

impl fmt::Display for RigSpec {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Hosted => formatter.write_str("hosted"),
            Self::Emulated(None) => formatter.write_str("emulated"),
            Self::Emulated(Some(elf)) => write!(formatter, "emulated:{}", elf.display()),
            Self::Exec(command) => write!(formatter, "exec:{command}"),
            Self::Serial { port, baud: None } => write!(formatter, "serial:{port}"),
            Self::Serial { port, baud: Some(baud) } => write!(formatter, "serial:{port}@{baud}"),
            Self::Probe(chip) => write!(formatter, "probe:{chip}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_comes_back_as_it_was_written() {
        for text in [
            "hosted",
            "emulated",
            "emulated:a/b.elf",
            "exec:python3 c.py {port}",
            "serial:/dev/ttyACM0",
            "serial:COM3@921600",
            "probe:STM32F407VG",
            "probe:STM32F407VG@0483:374b:066DFF",
        ] {
            assert_eq!(text.parse::<RigSpec>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn what_is_not_a_rig_is_refused() {
        for text in [
            "",
            "hosted:x",
            "emulated:",
            "exec",
            "serial:",
            "serial:@9600",
            "serial:p@",
            "serial:p@0",
            "probe",
            "can:0",
        ] {
            assert!(text.parse::<RigSpec>().is_err(), "{text}");
        }
    }
}
