//! Lists the kinds of rigs and parses `--rig`. A kind is a file in `rigs/` and a line of [`RIGS`].

mod emulated;
pub mod exec;
pub mod hosted;
mod probe;
mod rfc2217;
pub mod serial;
mod tcp;

use crate::factory::{
    Argument, Capability, ConnectError, ConnectOptions, FirmwareImage, Rig, RigFactory, RigProperties,
};
use crate::link::BoxedLink;
use crate::serial_port::SerialError;
use crate::wall_clock::WallClockLink;
use platebench_model::record::ClockKind;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

pub use tcp::NetworkError;

/// True if the device or the server may come back within seconds, such as a USB board that resets.
/// At the first connection the same errors are final, because a name may be wrong.
pub fn may_come_back(error: &ConnectError) -> bool {
    let is_port =
        |error| matches!(error, &SerialError::Open { .. } | &SerialError::Settings { .. } | &SerialError::InUse { .. });
    let is_server = |error| matches!(error, &NetworkError::Connect { .. } | &NetworkError::Settings { .. });
    error.downcast_ref().is_some_and(is_port) || error.downcast_ref().is_some_and(is_server)
}

/// In the order of help and messages.
#[rustfmt::skip] // One line per kind.
pub const RIGS: &[&RigFactory] = &[
    &hosted::RIG,
    &emulated::RIG,
    &exec::RIG,
    &serial::RIG,
    &tcp::RIG,
    &rfc2217::RIG,
    &probe::RIG,
];

/// Prints the syntax of each kind that is not filtered out: "a, b or c".
pub fn rig_syntaxes(filter: impl Fn(&RigFactory) -> bool) -> String {
    let mut syntaxes: Vec<_> = RIGS.iter().filter(|rig| filter(rig)).map(ToString::to_string).collect();
    match syntaxes.pop() {
        Some(last) if !syntaxes.is_empty() => format!("{} or {last}", syntaxes.join(", ")),
        last => last.unwrap_or_default(),
    }
}

/// Value of `--rig`, with valid arguments.
#[derive(Debug, Clone)]
pub struct RigSpec {
    text: String,
    factory: &'static RigFactory,
    properties: RigProperties,
    rig: Arc<dyn Rig>,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}`: {problem}, expected {}", rig_syntaxes(|_| true))]
pub struct SpecError {
    text: String,
    problem: String,
}

impl FromStr for RigSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let refuse = |problem: &str| Err(SpecError { text: text.to_owned(), problem: problem.to_owned() });
        let (name, rest) = text.split_once(':').map_or((text, None), |(name, rest)| (name, Some(rest)));
        if rest == Some("") {
            return refuse("nothing follows the colon");
        }
        let Some(factory) = RIGS.iter().find(|factory| factory.name == name) else {
            return refuse("unknown kind of rig");
        };
        match (factory.argument, rest) {
            (Argument::Required(_), None) => refuse("the colon and what follows it are missing"),
            (Argument::None, Some(_)) => refuse(&format!("the {name} rig has no argument")),
            _ => (factory.parse)(rest).map(|rig| Self::new(factory, text.to_owned(), rig)).or_else(refuse),
        }
    }
}

impl fmt::Display for RigSpec {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.text)
    }
}

impl PartialEq for RigSpec {
    fn eq(&self, other: &Self) -> bool {
        self.text == other.text
    }
}

impl RigSpec {
    fn new(factory: &'static RigFactory, text: String, rig: Box<dyn Rig>) -> Self {
        Self { text, factory, properties: rig.properties(), rig: rig.into() }
    }

    pub fn hosted() -> Self {
        Self::new(&hosted::RIG, "hosted".to_owned(), Box::new(hosted::HostedRig))
    }

    /// `None` for the built-in image.
    pub fn emulated(elf: Option<PathBuf>) -> Self {
        let text = elf.as_ref().map_or_else(|| "emulated".to_owned(), |elf| format!("emulated:{}", elf.display()));
        Self::new(&emulated::RIG, text, Box::new(emulated::EmulatedRig { elf }))
    }

    /// Name of the kind, such as `serial`.
    pub fn name(&self) -> &'static str {
        self.factory.name
    }

    pub fn has(&self, capability: Capability) -> bool {
        self.factory.capabilities.contains(&capability)
    }

    pub fn properties(&self) -> &RigProperties {
        &self.properties
    }

    pub fn default_clock(&self) -> ClockKind {
        self.properties.default_clock
    }

    pub fn baud(&self) -> Option<u32> {
        self.properties.baud
    }

    /// Path of the ELF; `None` for the built-in image and for rigs without an image.
    pub fn image(&self) -> Option<&Path> {
        match &self.properties.image {
            FirmwareImage::File(path) => Some(path),
            FirmwareImage::None | FirmwareImage::BuiltIn => None,
        }
    }

    pub fn allows_parallel_links(&self) -> bool {
        self.has(Capability::ParallelLinks)
    }

    pub fn is_simulated(&self) -> bool {
        self.has(Capability::Simulated)
    }

    /// True if the controller's clock runs while the plate waits. Such a controller needs a longer
    /// watchdog timeout in lockstep.
    pub fn has_own_clock(&self) -> bool {
        !self.is_simulated()
    }

    /// Checks what can be checked without starting a program or opening a device.
    pub fn check(&self) -> Result<(), ConnectError> {
        self.refuse_if(self.properties.unavailable)?;
        self.rig.check()
    }

    pub fn connect(&self) -> Result<BoxedLink, ConnectError> {
        self.connect_with(&ConnectOptions::default())
    }

    pub fn connect_real_time(&self) -> Result<BoxedLink, ConnectError> {
        self.connect_real_time_with(&ConnectOptions::default())
    }

    pub fn connect_with(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        self.refuse_if(self.properties.unavailable)?;
        self.rig.open(options)
    }

    pub fn connect_real_time_with(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        self.refuse_if(self.properties.no_real_time)?;
        let link = self.connect_with(options)?;
        Ok(if self.is_simulated() { Box::new(WallClockLink::new(link)) } else { link })
    }

    fn refuse_if(&self, reason: Option<&'static str>) -> Result<(), ConnectError> {
        reason.map_or(Ok(()), |reason| Err(ConnectError::Refused { rig: self.text.clone(), reason }))
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
