//! Parses `--rig`.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RigSpec {
    Hosted,
    /// Path of the ELF; `None` for the built-in image.
    Emulated(Option<PathBuf>),
    Exec(String),
    Serial {
        port: String,
        baud: Option<u32>,
    },
    /// `HOST:PORT` of a server that transports bytes unchanged.
    Tcp(String),
    /// Server at `address` (`HOST:PORT`), whose serial port the bench sets over Telnet (RFC 2217).
    Rfc2217 {
        address: String,
        baud: Option<u32>,
    },
    Probe {
        /// `CHIP[@VID:PID[:SERIAL]]`, see `probe::ProbeSpec`.
        board: String,
        elf: Option<PathBuf>,
        /// Serial port of the board; `None` for RTT through the probe.
        port: Option<String>,
        baud: Option<u32>,
    },
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}`: {problem}, expected hosted, emulated[:ELF], exec:COMMAND, serial:PORT[@BAUD], tcp:HOST:PORT, \
     rfc2217:HOST:PORT[@BAUD] or probe:CHIP[@VID:PID[:SERIAL]][,elf=ELF][,port=PORT[@BAUD]]"
)]
pub struct SpecError {
    text: String,
    problem: &'static str,
}

impl FromStr for RigSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let error = |problem| SpecError { text: text.to_owned(), problem };
        let refuse = |problem| Err(error(problem));
        let (kind, rest) = text.split_once(':').map_or((text, None), |(kind, rest)| (kind, Some(rest)));
        match (kind, rest) {
            ("hosted", None) => Ok(Self::Hosted),
            ("emulated", None) => Ok(Self::Emulated(None)),
            (_, Some("")) => refuse("nothing follows the colon"),
            ("emulated", Some(elf)) => Ok(Self::Emulated(Some(elf.into()))),
            ("exec", Some(command)) => Ok(Self::Exec(command.to_owned())),
            ("probe", Some(rest)) => parse_probe(rest).map_err(error),
            ("serial", Some(rest)) => {
                let (port, baud) = parse_port(rest).map_err(error)?;
                Ok(Self::Serial { port, baud })
            }
            ("tcp", Some(rest)) => parse_address(rest).map(Self::Tcp).map_err(error),
            ("rfc2217", Some(rest)) => {
                let (address, baud) = parse_port(rest).map_err(error)?;
                Ok(Self::Rfc2217 { address: parse_address(&address).map_err(error)?, baud })
            }
            ("exec" | "serial" | "probe" | "tcp" | "rfc2217", None) => {
                refuse("the colon and what follows it are missing")
            }
            ("hosted", Some(_)) => refuse("the hosted rig has no argument"),
            _ => refuse("unknown kind of rig"),
        }
    }
}

fn parse_port(text: &str) -> Result<(String, Option<u32>), &'static str> {
    let (port, baud) = text.rsplit_once('@').map_or((text, None), |(port, baud)| (port, Some(baud)));
    let baud = baud.map(|baud| baud.parse().ok().filter(|&baud| baud > 0).ok_or(())).transpose();
    match baud {
        Ok(baud) if !port.is_empty() => Ok((port.to_owned(), baud)),
        _ => Err("the port is missing, or the baud rate is not a whole number above 0"),
    }
}

/// Checks the form `HOST:PORT`. An IPv6 address must be in brackets.
fn parse_address(text: &str) -> Result<String, &'static str> {
    let wrong = "the address is not HOST:PORT with a port from 1 to 65535";
    let (host, port) = text.rsplit_once(':').ok_or(wrong)?;
    let is_bracketed = host.starts_with('[') && host.ends_with(']');
    let is_host = !host.is_empty() && (is_bracketed || !host.contains(':')) && !host.contains(char::is_whitespace);
    let is_port = port.bytes().all(|byte| byte.is_ascii_digit()) && port.parse::<u16>().is_ok_and(|port| port > 0);
    if is_host && is_port { Ok(text.to_owned()) } else { Err(wrong) }
}

/// Parses the text after `probe:`. A path in it cannot contain a comma.
fn parse_probe(text: &str) -> Result<RigSpec, &'static str> {
    let mut parts = text.split(',');
    let chip = parts.next().filter(|chip| !chip.is_empty()).ok_or("the chip is missing")?;
    let (mut elf, mut port, mut baud) = (None, None, None);
    for part in parts {
        match part.split_once('=') {
            Some(("elf", path)) if elf.is_none() && !path.is_empty() => elf = Some(path.into()),
            Some(("port", text)) if port.is_none() => {
                let (path, rate) = parse_port(text)?;
                (port, baud) = (Some(path), rate);
            }
            Some(("elf" | "port", _)) => return Err("elf= or port= appears twice, or elf= is empty"),
            _ => return Err("only elf= and port= may follow a comma"),
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
            Self::Tcp(address) => write!(formatter, "tcp:{address}"),
            Self::Rfc2217 { address, baud: None } => write!(formatter, "rfc2217:{address}"),
            Self::Rfc2217 { address, baud: Some(baud) } => write!(formatter, "rfc2217:{address}@{baud}"),
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
    fn prints_every_kind_as_it_was_parsed() {
        for text in [
            "hosted",
            "emulated",
            "emulated:a/b.elf",
            "exec:python3 c.py {port}",
            "serial:/dev/ttyACM0",
            "serial:COM3@921600",
            "tcp:lab-3:4001",
            "tcp:[::1]:4001",
            "rfc2217:lab-3:4001",
            "rfc2217:192.0.2.7:4001@921600",
            "probe:STM32F407VG",
            "probe:STM32F407VG@0483:374b:066DFF",
            "probe:STM32F407VG,port=/dev/ttyACM0",
            "probe:STM32F427VI@0483:374b,elf=a/b.elf,port=COM3@921600",
        ] {
            assert_eq!(text.parse::<RigSpec>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn rejects_a_wrong_form() {
        for text in [
            "",
            "hosted:x",
            "emulated:",
            "exec",
            "serial:",
            "serial:@9600",
            "serial:p@",
            "serial:p@0",
            "tcp:lab-3",
            "tcp:lab-3:",
            "tcp::4001",
            "tcp:lab-3:0",
            "tcp:lab-3:+1",
            "tcp:lab-3:65536",
            "tcp:::1:4001",
            "tcp:lab-3:4001@9600",
            "rfc2217:lab-3:4001@0",
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
