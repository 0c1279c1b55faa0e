//! Flashes, restarts and reads a board through probe-rs, on the probe's thread.

use super::error::{ProbeError, error_chain};
use super::image::{FlashImage, read_crash};
use crate::crash_report::CrashReport;
use probe_rs::config::{MemoryRegion, Registry};
use probe_rs::flashing::DownloadOptions;
use probe_rs::probe::list::{Accessibility, Lister, ProbeListItem};
use probe_rs::probe::{DebugProbeError, DebugProbeInfo, DebugProbeSelector, Probe, ProbeCreationError, WireProtocol};
use probe_rs::rtt::{DownChannel, Rtt, ScanRegion, UpChannel, try_attach_to_rtt};
use probe_rs::{Core, MemoryInterface, Permissions, Session, Target};
use std::fmt;
use std::io::ErrorKind;
use std::str::FromStr;
use std::time::{Duration, Instant};
use tracing::{debug, warn};

/// Address of `DBGMCU_IDCODE`: bits 0 to 11 are the device code, bits 16 to 31 the revision.
const IDCODE: u64 = 0xe004_2000;
/// Device codes from ST's reference manuals, families, and prefixes of the part numbers.
const DEVICES: [(u16, &str, &[&str]); 10] = [
    (0x413, "STM32F405/407/415/417", &["STM32F405", "STM32F407", "STM32F415", "STM32F417"]),
    (0x419, "STM32F427/429/437/439", &["STM32F427", "STM32F429", "STM32F437", "STM32F439"]),
    (0x421, "STM32F446", &["STM32F446"]),
    (
        0x423,
        "STM32F401xB/C",
        &["STM32F401CB", "STM32F401CC", "STM32F401RB", "STM32F401RC", "STM32F401VB", "STM32F401VC"],
    ),
    (0x431, "STM32F411", &["STM32F411"]),
    (
        0x433,
        "STM32F401xD/E",
        &["STM32F401CD", "STM32F401CE", "STM32F401RD", "STM32F401RE", "STM32F401VD", "STM32F401VE"],
    ),
    (0x434, "STM32F469/479", &["STM32F469", "STM32F479"]),
    (0x441, "STM32F412", &["STM32F412"]),
    (0x458, "STM32F410", &["STM32F410"]),
    (0x463, "STM32F413/423", &["STM32F413", "STM32F423"]),
];
const UNKNOWN_FAMILY: &str = "not a known STM32F4";

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChipId {
    pub name: String,
    pub idcode: u32,
    /// Selector (`VID:PID[:SERIAL]`) and type of the probe.
    pub probe: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FlashOutcome {
    Unchanged,
    Written(usize),
}

#[derive(Debug)]
pub(super) struct Board {
    session: Session,
    chip: String,
}

impl Board {
    /// Returns the device code and the description of the chip. Does not use a probe.
    pub(super) fn resolve_target(spec: &ProbeSpec) -> Result<(u16, Target), ProbeError> {
        let chip = spec.chip.to_ascii_uppercase();
        let matches = |prefixes: &[&str]| prefixes.iter().any(|prefix| chip.starts_with(prefix));
        let (expected, _, _) = *DEVICES
            .iter()
            .find(|(_, _, prefixes)| matches(prefixes))
            .ok_or_else(|| ProbeError::UnsupportedChip { chip: spec.chip.clone() })?;
        let target = Registry::from_builtin_families().get_target_by_name(&chip).map_err(|error| {
            ProbeError::UnknownChip { chip: spec.chip.clone(), cause: super::error::error_chain(&error) }
        })?;
        Ok((expected, target))
    }

    pub(super) fn attach(spec: &ProbeSpec, lister: &Lister) -> Result<(Self, ChipId), ProbeError> {
        let (expected, target) = Self::resolve_target(spec)?;
        let (probe, probe_name) = open_probe(spec, lister)?;
        let chip = target.name.clone();
        let no_target =
            |cause| ProbeError::NoTarget { chip: chip.clone(), probe: probe_name.clone(), cause: Box::new(cause) };
        let mut session = probe.attach(target, Permissions::default()).map_err(no_target)?;
        let idcode = session.core(0).and_then(|mut core| core.read_word_32(IDCODE)).map_err(no_target)?;
        let found = (idcode & 0xfff) as u16;
        if found != expected {
            let family = DEVICES.iter().find(|(id, _, _)| *id == found).map_or(UNKNOWN_FAMILY, |(_, family, _)| family);
            return Err(ProbeError::WrongChip { expected: chip, found, family });
        }
        debug!(chip, idcode = format_args!("{idcode:#010x}"), probe = probe_name, "attached");
        let id = ChipId { name: chip.clone(), idcode, probe: probe_name };
        Ok((Self { session, chip }, id))
    }

    fn core(&mut self) -> Result<Core<'_>, ProbeError> {
        self.session.core(0).map_err(ProbeError::line_error("reaching the processor"))
    }

    pub(super) fn flash(&mut self, image: &FlashImage) -> Result<FlashOutcome, ProbeError> {
        self.check_flash_range(image)?;
        if self.first_difference(image)?.is_none() {
            return Ok(FlashOutcome::Unchanged);
        }
        let failed = |error| ProbeError::Flash(Box::new(error));
        let mut loader = self.session.target().flash_loader();
        for segment in image.segments() {
            loader.add_data(u64::from(segment.address), &segment.bytes).map_err(failed)?;
        }
        loader.commit(&mut self.session, DownloadOptions::default()).map_err(failed)?;
        match self.first_difference(image)? {
            None => Ok(FlashOutcome::Written(image.flash_bytes())),
            Some((address, expected, found)) => Err(ProbeError::Verify { address, expected, found }),
        }
    }

    fn check_flash_range(&self, image: &FlashImage) -> Result<(), ProbeError> {
        let flash: Vec<_> = self.session.target().memory_map.iter().filter_map(MemoryRegion::as_nvm_region).collect();
        for segment in image.segments() {
            let start = u64::from(segment.address);
            let end = start + segment.bytes.len() as u64;
            if !flash.iter().any(|region| region.range.start <= start && end <= region.range.end) {
                let (address, bytes) = (segment.address, segment.bytes.len());
                return Err(ProbeError::NotInFlash { chip: self.chip.clone(), address, bytes });
            }
        }
        Ok(())
    }

    fn first_difference(&mut self, image: &FlashImage) -> Result<Option<(u32, u8, u8)>, ProbeError> {
        let mut core = self.core()?;
        for segment in image.segments() {
            let mut found = vec![0; segment.bytes.len()];
            core.read(u64::from(segment.address), &mut found).map_err(ProbeError::line_error("reading the flash"))?;
            let different = (segment.address..).zip(segment.bytes.iter().zip(found)).find(|(_, (a, b))| *a != b);
            if let Some((address, (&expected, found))) = different {
                return Ok(Some((address, expected, found)));
            }
        }
        Ok(None)
    }

    /// First clears the RTT control block at `rtt`, which may be that of earlier firmware.
    pub(super) fn restart(&mut self, rtt: Option<u64>, timeout: Duration) -> Result<(), ProbeError> {
        let until = Instant::now() + timeout;
        let mut core = self.core()?;
        if let Some(address) = rtt {
            core.halt(timeout.min(Duration::from_millis(500)))
                .map_err(ProbeError::line_error("halting the processor"))?;
            Rtt::clear_control_block(&mut core, &ScanRegion::Exact(address))
                .map_err(|error| ProbeError::Rtt(super::error::error_chain(&error)))?;
        }
        core.reset().map_err(ProbeError::line_error("resetting the chip"))?;
        while core.core_halted().map_err(ProbeError::line_error("starting the firmware"))? {
            if Instant::now() >= until {
                return Err(ProbeError::CallTimedOut { doing: "starting the firmware", waited: timeout });
            }
            core.run().map_err(ProbeError::line_error("starting the firmware"))?;
        }
        Ok(())
    }

    pub(super) fn read_crash(&mut self, image: &FlashImage) -> Result<Option<CrashReport>, ProbeError> {
        read_crash(&mut self.core()?, image)
    }

    pub(super) fn rtt(&mut self, address: u64, timeout: Duration) -> Result<RttChannels, ProbeError> {
        let rtt = try_attach_to_rtt(&mut self.core()?, timeout, &ScanRegion::Exact(address)).map_err(|error| {
            ProbeError::RttNotStarted { address, waited: timeout, cause: super::error::error_chain(&error) }
        })?;
        RttChannels::from_rtt(rtt)
    }

    pub(super) fn exchange(
        &mut self,
        channels: &mut RttChannels,
        bytes: &[u8],
        timeout: Duration,
    ) -> Result<Vec<u8>, ProbeError> {
        channels.exchange(&mut self.core()?, bytes, timeout)
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        // The processor must run, because a halted one cannot take the drive to 0 V.
        let resume = |mut core: Core<'_>| if core.core_halted()? { core.run() } else { Ok(()) };
        if let Err(error) = self.session.core(0).and_then(resume) {
            warn!(error = super::error::error_chain(&error), "the processor may be halted");
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProbeSpec {
    pub chip: String,
    /// `None` selects the only connected probe.
    pub selector: Option<DebugProbeSelector>,
}

impl FromStr for ProbeSpec {
    type Err = ProbeError;

    fn from_str(text: &str) -> Result<Self, ProbeError> {
        let (chip, selector) = text.split_once('@').map_or((text, None), |(chip, rest)| (chip, Some(rest)));
        let refuse = || ProbeError::Spec { text: text.to_owned() };
        if chip.is_empty() {
            return Err(refuse());
        }
        let selector = selector.map(str::parse).transpose().map_err(|_| refuse())?;
        Ok(Self { chip: chip.to_owned(), selector })
    }
}

impl fmt::Display for ProbeSpec {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.chip)?;
        self.selector.as_ref().map_or(Ok(()), |selector| write!(formatter, "@{selector}"))
    }
}

pub(super) fn open_probe(spec: &ProbeSpec, lister: &Lister) -> Result<(Probe, String), ProbeError> {
    let mut found = lister.list_with_access(spec.selector.as_ref());
    let item = match found.len() {
        0 => {
            let others =
                if spec.selector.is_some() { selectors_of(&lister.list_all_with_access()) } else { Vec::new() };
            return Err(ProbeError::NoProbe { wanted: spec.selector.as_ref().map(ToString::to_string), others });
        }
        1 => found.remove(0),
        _ => return Err(ProbeError::SeveralProbes { found: selectors_of(&found) }),
    };
    let name = selector_of(&item.info);
    if item.accessibility == Accessibility::PermissionDenied {
        return Err(ProbeError::PermissionDenied { probe: name });
    }
    let opened = lister.open(DebugProbeSelector::from(&item.info));
    let mut probe = opened.map_err(|cause| open_error(&name, cause))?;
    probe.select_protocol(WireProtocol::Swd).map_err(|cause| open_error(&name, cause))?;
    Ok((probe, name))
}

fn selector_of(info: &DebugProbeInfo) -> String {
    let serial = info.serial_number.as_ref().map(|serial| format!(":{serial}")).unwrap_or_default();
    format!("{:04x}:{:04x}{serial} ({})", info.vendor_id, info.product_id, info.identifier)
}

fn selectors_of(items: &[ProbeListItem]) -> Vec<String> {
    items.iter().map(|item| selector_of(&item.info)).collect()
}

fn open_error(probe: &str, cause: DebugProbeError) -> ProbeError {
    let probe = probe.to_owned();
    let kind = match &cause {
        DebugProbeError::Usb(error) | DebugProbeError::ProbeCouldNotBeCreated(ProbeCreationError::Usb(error)) => {
            Some(error.kind())
        }
        _ => None,
    };
    let text = error_chain(&cause);
    match kind {
        Some(ErrorKind::PermissionDenied) => ProbeError::PermissionDenied { probe },
        Some(ErrorKind::ResourceBusy) => ProbeError::Busy { probe, cause: text },
        // The USB library reports a busy probe only in the text of its error.
        _ if text.contains("busy") => ProbeError::Busy { probe, cause: text },
        _ => ProbeError::Open { probe, cause: Box::new(cause) },
    }
}

/// RTT channel 0. It exchanges bytes on the probe's thread.
#[derive(Debug)]
pub(super) struct RttChannels {
    up: UpChannel,
    down: DownChannel,
}

impl RttChannels {
    pub(super) fn from_rtt(rtt: Rtt) -> Result<Self, ProbeError> {
        let up = rtt.up_channels.into_iter().find(|channel| channel.number() == 0);
        let down = rtt.down_channels.into_iter().find(|channel| channel.number() == 0);
        Ok(Self {
            up: up.ok_or(ProbeError::RttChannel { direction: "up channel 0 (to the bench)" })?,
            down: down.ok_or(ProbeError::RttChannel { direction: "down channel 0 (from the bench)" })?,
        })
    }

    /// Reads waiting bytes. Then sends `bytes`, if any, and reads to the end of the next frame.
    pub(super) fn exchange(
        &mut self,
        core: &mut Core<'_>,
        bytes: &[u8],
        timeout: Duration,
    ) -> Result<Vec<u8>, ProbeError> {
        let until = Instant::now() + timeout;
        let mut received = Vec::new();
        self.read(core, &mut received)?;
        if bytes.is_empty() {
            return Ok(received);
        }
        // If a part of an unsolicited frame has arrived, the end of that frame precedes the answer.
        let mut ends = if received.last().is_some_and(|&byte| byte != 0) { 2 } else { 1 };
        let mut unsent = bytes;
        loop {
            if !unsent.is_empty() {
                let sent = self.down.write(core, unsent).map_err(rtt_error)?;
                unsent = unsent.get(sent..).unwrap_or_default();
            }
            let before = received.len();
            self.read(core, &mut received)?;
            let new = received.iter().skip(before).filter(|&&byte| byte == 0).count();
            ends -= new.min(ends);
            if ends == 0 || Instant::now() >= until {
                return Ok(received);
            }
        }
    }

    fn read(&mut self, core: &mut Core<'_>, received: &mut Vec<u8>) -> Result<(), ProbeError> {
        let mut buffer = [0; 256];
        let count = self.up.read(core, &mut buffer).map_err(rtt_error)?;
        received.extend(buffer.iter().take(count));
        Ok(())
    }
}

fn rtt_error(error: probe_rs::rtt::Error) -> ProbeError {
    match error {
        probe_rs::rtt::Error::Probe(cause) => ProbeError::Line { doing: "an RTT exchange", cause: Box::new(cause) },
        other => ProbeError::Rtt(error_chain(&other)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_chip_and_selector_as_parsed() {
        for text in ["STM32F407VG", "STM32F427VI@0483:374b", "STM32F405RG@0d28:0204:0240A1:B2"] {
            assert_eq!(text.parse::<ProbeSpec>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn rejects_a_wrong_chip_or_selector() {
        for text in ["", "@0483:374b", "STM32F407VG@", "STM32F407VG@0483", "STM32F407VG@st:link"] {
            let error = text.parse::<ProbeSpec>().unwrap_err().to_string();
            assert!(error.contains("CHIP[@VID:PID[:SERIAL]]"), "{text}: {error}");
        }
    }
}
