//! What is done with probe-rs, on the probe's own thread.

use super::error::ProbeError;
use super::fault::{Fault, inspect};
use super::image::Image;
use super::link::Channels;
use super::spec::ProbeSpec;
use super::{Lister, choose};
use probe_rs::config::{MemoryRegion, Registry};
use probe_rs::flashing::DownloadOptions;
use probe_rs::rtt::{Rtt, ScanRegion, try_attach_to_rtt};
use probe_rs::{Core, MemoryInterface, Permissions, Session, Target};
use std::time::{Duration, Instant};
use tracing::{debug, warn};

/// `DBGMCU_IDCODE`: device identity in the lower twelve bits, revision in the upper sixteen.
const IDCODE: u64 = 0xe004_2000;
/// Device identities of the STM32F4, from the reference manuals, and the starts of the names that go with them.
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
const UNKNOWN_FAMILY: &str = "not an STM32F4 that the bench knows";

/// Who the chip is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChipId {
    /// The name in the chip description that is worked with.
    pub name: String,
    /// `DBGMCU_IDCODE`, whole.
    pub idcode: u32,
    /// The probe, as a user can write it into a selector.
    pub probe: String,
}

/// What flashing did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flashed {
    /// The flash held every byte of the image already.
    AlreadyThere,
    /// So many bytes were written and read back.
    Written(usize),
}

/// A session with the chip.
#[derive(Debug)]
pub(super) struct Board {
    session: Session,
    chip: String,
}

impl Board {
    /// The device identity that the chip must have, and how it is worked with. Touches no probe.
    pub(super) fn describe(spec: &ProbeSpec) -> Result<(u16, Target), ProbeError> {
        let asked = spec.chip.to_ascii_uppercase();
        let is_asked = |starts: &[&str]| starts.iter().any(|start| asked.starts_with(start));
        let (expected, _, _) = *DEVICES
            .iter()
            .find(|(_, _, starts)| is_asked(starts))
            .ok_or_else(|| ProbeError::UnsupportedChip { chip: spec.chip.clone() })?;
        let target = Registry::from_builtin_families()
            .get_target_by_name(&asked)
            .map_err(|error| ProbeError::UnknownChip { chip: spec.chip.clone(), cause: super::error::chain(&error) })?;
        Ok((expected, target))
    }

    /// Finds probe and chip and checks who the chip is.
    pub(super) fn attach(spec: &ProbeSpec, lister: &Lister) -> Result<(Self, ChipId), ProbeError> {
        let (expected, target) = Self::describe(spec)?;
        let (probe, probe_name) = choose::open(spec, lister)?;
        let chip = target.name.clone();
        let no_target =
            |cause| ProbeError::NoTarget { chip: chip.clone(), probe: probe_name.clone(), cause: Box::new(cause) };
        let mut session = probe.attach(target, Permissions::default()).map_err(no_target)?;
        let idcode = session.core(0).and_then(|mut core| core.read_word_32(IDCODE)).map_err(no_target)?;
        let found = (idcode & 0xfff) as u16;
        if found != expected {
            let family = DEVICES.iter().find(|(id, _, _)| *id == found).map_or(UNKNOWN_FAMILY, |(_, family, _)| family);
            return Err(ProbeError::WrongChip { asked: chip, found, family });
        }
        debug!(chip, idcode = format_args!("{idcode:#010x}"), probe = probe_name, "attached");
        let id = ChipId { name: chip.clone(), idcode, probe: probe_name };
        Ok((Self { session, chip }, id))
    }

    fn core(&mut self) -> Result<Core<'_>, ProbeError> {
        self.session.core(0).map_err(ProbeError::line("reaching the processor"))
    }

    /// Writes the image unless it is there, and reads it back.
    pub(super) fn flash(&mut self, image: &Image) -> Result<Flashed, ProbeError> {
        self.check_fit(image)?;
        if self.first_difference(image)?.is_none() {
            return Ok(Flashed::AlreadyThere);
        }
        let failed = |error| ProbeError::Flash(Box::new(error));
        let mut loader = self.session.target().flash_loader();
        for segment in image.segments() {
            loader.add_data(u64::from(segment.address), &segment.bytes).map_err(failed)?;
        }
        loader.commit(&mut self.session, DownloadOptions::default()).map_err(failed)?;
        match self.first_difference(image)? {
            None => Ok(Flashed::Written(image.flash_bytes())),
            Some((address, expected, found)) => Err(ProbeError::Verify { address, expected, found }),
        }
    }

    fn check_fit(&self, image: &Image) -> Result<(), ProbeError> {
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
            core.read(u64::from(segment.address), &mut found).map_err(ProbeError::line("reading the flash"))?;
            let different = (segment.address..).zip(segment.bytes.iter().zip(found)).find(|(_, (a, b))| *a != b);
            if let Some((address, (&expected, found))) = different {
                return Ok(Some((address, expected, found)));
            }
        }
        Ok(None)
    }

    /// Resets the chip and lets it run. What an earlier run left of RTT is wiped out first, so that only a new control block is believed.
    pub(super) fn restart(&mut self, rtt: Option<u64>, patience: Duration) -> Result<(), ProbeError> {
        let until = Instant::now() + patience;
        let mut core = self.core()?;
        if let Some(address) = rtt {
            core.halt(patience.min(Duration::from_millis(500))).map_err(ProbeError::line("halting the processor"))?;
            Rtt::clear_control_block(&mut core, &ScanRegion::Exact(address))
                .map_err(|error| ProbeError::Rtt(super::error::chain(&error)))?;
        }
        core.reset().map_err(ProbeError::line("resetting the chip"))?;
        while core.core_halted().map_err(ProbeError::line("starting the firmware"))? {
            if Instant::now() >= until {
                return Err(ProbeError::Hung { doing: "starting the firmware", waited: patience });
            }
            core.run().map_err(ProbeError::line("starting the firmware"))?;
        }
        Ok(())
    }

    /// The trap that the processor is in, if it is in one.
    pub(super) fn fault(&mut self, image: &Image) -> Result<Option<Fault>, ProbeError> {
        inspect(&mut self.core()?, image)
    }

    /// Finds RTT at `address`.
    pub(super) fn rtt(&mut self, address: u64, patience: Duration) -> Result<Channels, ProbeError> {
        let rtt = try_attach_to_rtt(&mut self.core()?, patience, &ScanRegion::Exact(address)).map_err(|error| {
            ProbeError::RttNotStarted { address, waited: patience, cause: super::error::chain(&error) }
        })?;
        Channels::of(rtt)
    }

    /// Sends `bytes`, then reads up to the end of the next frame, or only reads.
    pub(super) fn exchange(
        &mut self,
        channels: &mut Channels,
        bytes: &[u8],
        patience: Duration,
    ) -> Result<Vec<u8>, ProbeError> {
        channels.exchange(&mut self.core()?, bytes, patience)
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        // A halted processor does not feed its watchdog and does not drive 0 V either.
        let let_run = |mut core: Core<'_>| if core.core_halted()? { core.run() } else { Ok(()) };
        if let Err(error) = self.session.core(0).and_then(let_run) {
            warn!(error = super::error::chain(&error), "the processor may be halted");
        }
    }
}
