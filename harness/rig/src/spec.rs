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
    /// A board on a debug probe.
    Probe {
        /// `CHIP[@VID:PID[:SERIAL]]`, read by `probe::ProbeSpec`.
        board: String,
        /// The firmware that it is to run; the image that came with the bench where none is named.
        elf: Option<PathBuf>,
        /// Path of the board's serial port; RTT through the probe where none is named.
        port: Option<String>,
        /// Bits per second of that port.
        baud: Option<u32>,
    },
}

/// A rig that was not understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}`: {problem}, expected hosted, emulated[:ELF], exec:COMMAND, serial:PORT[@BAUD] or probe:CHIP[@VID:PID[:SERIAL]][,elf=ELF][,port=PORT[@BAUD]]"
)]
pub struct SpecError {
    text: String,
    problem: &'static str,
}

impl FromStr for RigSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let refused = |problem| SpecError { text: text.to_owned(), problem };
        let refuse = |problem| Err(refused(problem));
        let (kind, rest) = text.split_once(':').map_or((text, None), |(kind, rest)| (kind, Some(rest)));
        match (kind, rest) {
            ("hosted", None) => Ok(Self::Hosted),
            ("emulated", None) => Ok(Self::Emulated(None)),
            (_, Some("")) => refuse("nothing after the colon"),
            ("emulated", Some(elf)) => Ok(Self::Emulated(Some(elf.into()))),
            ("exec", Some(command)) => Ok(Self::Exec(command.to_owned())),
            ("probe", Some(rest)) => on_probe(rest).map_err(refused),
            ("serial", Some(rest)) => {
                let (port, baud) = port_and_baud(rest).map_err(refused)?;
                Ok(Self::Serial { port, baud })
            }
            ("exec" | "serial" | "probe", None) => refuse("something is missing after the kind"),
            ("hosted", Some(_)) => refuse("the hosted rig takes nothing"),
            _ => refuse("unknown kind"),
        }
    }
}

/// `PORT[@BAUD]`.
fn port_and_baud(text: &str) -> Result<(String, Option<u32>), &'static str> {
    let (port, baud) = text.rsplit_once('@').map_or((text, None), |(port, baud)| (port, Some(baud)));
    let baud = baud.map(|baud| baud.parse().ok().filter(|&baud| baud > 0).ok_or(())).transpose();
    match baud {
        Ok(baud) if !port.is_empty() => Ok((port.to_owned(), baud)),
        _ => Err("no port or no baud rate"),
    }
}

/// What stands after `probe:`. A path with a comma cannot be written.
fn on_probe(text: &str) -> Result<RigSpec, &'static str> {
    let mut parts = text.split(',');
    let chip = parts.next().filter(|chip| !chip.is_empty()).ok_or("no chip")?;
    let (mut elf, mut port, mut baud) = (None, None, None);
    for part in parts {
        match part.split_once('=') {
            Some(("elf", path)) if elf.is_none() && !path.is_empty() => elf = Some(path.into()),
            Some(("port", text)) if port.is_none() => {
                let (path, rate) = port_and_baud(text)?;
                (port, baud) = (Some(path), rate);
            }
            Some(("elf" | "port", _)) => return Err("elf or port twice, or elf without a file"),
            _ => return Err("after the comma only elf= and port= can stand"),
        }
    }
    Ok(RigSpec::Probe { board: chip.to_owned(), elf, port, baud })
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
            Self::Probe { board, elf, port, baud } => {
                write!(formatter, "probe:{board}")?;
                elf.as_ref().map_or(Ok(()), |elf| write!(formatter, ",elf={}", elf.display()))?;
                port.as_ref().map_or(Ok(()), |port| write!(formatter, ",port={port}"))?;
                baud.map_or(Ok(()), |baud| write!(formatter, "@{baud}"))
            }
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
            "probe:STM32F407VG,port=/dev/ttyACM0",
            "probe:STM32F427VI@0483:374b,elf=a/b.elf,port=COM3@921600",
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
            "probe:,port=p",
            "probe:STM32F407VG,",
            "probe:STM32F407VG,p",
            "probe:STM32F407VG,elf=",
            "probe:STM32F407VG,elf=a,elf=b",
            "probe:STM32F407VG,port=",
            "probe:STM32F407VG,port=p@0",
            "probe:STM32F407VG,port=p,port=q",
            "can:0",
        ] {
            assert!(text.parse::<RigSpec>().is_err(), "{text}");
        }
    }
}
