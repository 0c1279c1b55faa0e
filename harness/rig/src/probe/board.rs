//! Flashes, restarts and reads a board through probe-rs, on the probe's thread.

use super::crash::read_crash;
use super::error::ProbeError;
use super::image::Image;
use super::rtt_channels::RttChannels;
use super::selection;
use super::spec::ProbeSpec;
use crate::crash_report::CrashReport;
use probe_rs::config::{MemoryRegion, Registry};
use probe_rs::flashing::DownloadOptions;
use probe_rs::probe::list::Lister;
use probe_rs::rtt::{Rtt, ScanRegion, try_attach_to_rtt};
use probe_rs::{Core, MemoryInterface, Permissions, Session, Target};
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
        let (probe, probe_name) = selection::open_probe(spec, lister)?;
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

    pub(super) fn flash(&mut self, image: &Image) -> Result<FlashOutcome, ProbeError> {
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

    fn check_flash_range(&self, image: &Image) -> Result<(), ProbeError> {
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

    fn first_difference(&mut self, image: &Image) -> Result<Option<(u32, u8, u8)>, ProbeError> {
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

    pub(super) fn read_crash(&mut self, image: &Image) -> Result<Option<CrashReport>, ProbeError> {
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
