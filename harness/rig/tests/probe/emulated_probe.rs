//! Emulates a debug probe: debug port and memory access port, register by register.

use crate::chip::Chip;
use probe_rs::CoreStatus;
use probe_rs::architecture::arm::sequences::ArmDebugSequence;
use probe_rs::architecture::arm::{
    ArmCommunicationInterface, ArmDebugInterface, ArmError, DapError, DapProbe, RawDapAccess, RegisterAddress,
};
use probe_rs::probe::list::{Accessibility, Lister, ProbeListItem, ProbeLister};
use probe_rs::probe::{
    DebugProbe, DebugProbeError, DebugProbeInfo, DebugProbeSelector, Probe, ProbeCreationError, ProbeFactory,
    WireProtocol,
};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::sleep;
use std::time::Duration;

#[derive(Clone)]
pub(crate) struct SharedChip(Arc<Mutex<Chip>>);

impl fmt::Debug for SharedChip {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("SharedChip")
    }
}

impl SharedChip {
    pub(crate) fn new() -> Self {
        Self(Arc::new(Mutex::new(Chip::new())))
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, Chip> {
        self.0.lock().unwrap()
    }

    pub(crate) fn written(&self) -> (u32, u32) {
        let chip = self.lock();
        (chip.erased_sectors, chip.programmed_pages)
    }

    pub(crate) fn lister(&self) -> impl FnOnce() -> Lister + Send + 'static {
        self.lister_of(vec![("ST-Link V2-1", 0x0483, 0x374b, "066DFF")], OpenResult::Works)
    }

    pub(crate) fn lister_of(
        &self,
        probes: Vec<(&'static str, u16, u16, &'static str)>,
        opening: OpenResult,
    ) -> impl FnOnce() -> Lister + Send + 'static {
        let list = ProbeList { chip: self.clone(), probes, opening };
        move || Lister::with_lister(Box::new(list))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum OpenResult {
    Works,
    Forbidden,
    Busy,
    Fails,
}

#[derive(Debug)]
struct ProbeList {
    chip: SharedChip,
    probes: Vec<(&'static str, u16, u16, &'static str)>,
    opening: OpenResult,
}

impl ProbeLister for ProbeList {
    fn open(&self, _: &DebugProbeSelector) -> Result<Probe, DebugProbeError> {
        match self.opening {
            OpenResult::Works => Ok(Probe::new(EmulatedProbe::new(self.chip.clone()))),
            OpenResult::Busy => {
                let busy = std::io::Error::other("interface is busy");
                Err(DebugProbeError::ProbeCouldNotBeCreated(ProbeCreationError::Usb(busy)))
            }
            OpenResult::Forbidden | OpenResult::Fails => {
                Err(DebugProbeError::ProbeCouldNotBeCreated(ProbeCreationError::CouldNotOpen))
            }
        }
    }

    fn list_with_access(&self, selector: Option<&DebugProbeSelector>) -> Vec<ProbeListItem> {
        let accessibility = match self.opening {
            OpenResult::Forbidden => Accessibility::PermissionDenied,
            _ => Accessibility::Accessible,
        };
        let info = |&(name, vendor, product, serial): &(&str, u16, u16, &str)| {
            DebugProbeInfo::new(name, vendor, product, Some(serial.to_owned()), &Factory, None, false)
        };
        let matches = |info: &DebugProbeInfo| selector.is_none_or(|selector| selector.matches_probe(info));
        self.probes.iter().map(info).filter(matches).map(|info| ProbeListItem { info, accessibility }).collect()
    }
}

#[derive(Debug)]
struct Factory;

impl fmt::Display for Factory {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("emulated")
    }
}

impl ProbeFactory for Factory {
    fn open(&self, _: &DebugProbeSelector) -> Result<Box<dyn DebugProbe>, DebugProbeError> {
        Err(DebugProbeError::ProbeCouldNotBeCreated(ProbeCreationError::NotFound))
    }

    fn list_probes(&self) -> Vec<ProbeListItem> {
        Vec::new()
    }
}

#[derive(Debug)]
struct EmulatedProbe {
    chip: SharedChip,
    select: u32,
    power: u32,
    status: u32,
    target: u32,
}

impl EmulatedProbe {
    fn new(chip: SharedChip) -> Self {
        Self { chip, select: 0, power: 0, status: 0x0300_0042, target: 0 }
    }

    fn size(&self) -> u32 {
        1 << (self.status & 3)
    }

    fn advance(&mut self) {
        // The automatic increment changes only the lower ten bits of the address.
        if self.status & 0x30 != 0 {
            self.target = self.target & !0x3ff | (self.target + self.size()) & 0x3ff;
        }
    }

    /// Returns the chip, after the planned faults of the debug line.
    fn line(&self) -> Result<MutexGuard<'_, Chip>, ArmError> {
        loop {
            let mut chip = self.chip.lock();
            if chip.memory_hangs {
                drop(chip);
                sleep(Duration::from_millis(5));
                continue;
            }
            if chip.failing_accesses > 0 {
                chip.failing_accesses -= 1;
                return Err(ArmError::Dap(DapError::NoAcknowledge));
            }
            return Ok(chip);
        }
    }

    fn is_memory_port(&self) -> bool {
        self.select >> 24 == 0
    }
}

impl RawDapAccess for EmulatedProbe {
    fn raw_read_register(&mut self, address: RegisterAddress) -> Result<u32, ArmError> {
        match address {
            RegisterAddress::DpRegister(register) => Ok(match register.address {
                0x0 => 0x2ba0_1477,
                0x4 => self.power | self.power << 1 & 0xa000_0000,
                _ => 0,
            }),
            RegisterAddress::ApRegister(_) if !self.is_memory_port() => Ok(0),
            RegisterAddress::ApRegister(0x00) => Ok(self.status),
            RegisterAddress::ApRegister(0x04) => Ok(self.target),
            RegisterAddress::ApRegister(0x0c) => {
                let value =
                    self.line()?.read(self.target, self.size()).ok_or(ArmError::Dap(DapError::FaultResponse))?;
                let lane = 8 * (self.target & 3);
                self.advance();
                Ok(value << lane)
            }
            RegisterAddress::ApRegister(0xf8) => Ok(0xe00f_f003),
            RegisterAddress::ApRegister(0xfc) => Ok(0x2477_0011),
            RegisterAddress::ApRegister(_) => Ok(0),
        }
    }

    fn raw_write_register(&mut self, address: RegisterAddress, value: u32) -> Result<(), ArmError> {
        match address {
            RegisterAddress::DpRegister(register) => match register.address {
                0x4 => self.power = value & 0x5000_0000,
                0x8 => self.select = value,
                _ => {}
            },
            RegisterAddress::ApRegister(_) if !self.is_memory_port() => {}
            RegisterAddress::ApRegister(0x00) => self.status = value | 0x40,
            RegisterAddress::ApRegister(0x04) => self.target = value,
            RegisterAddress::ApRegister(0x0c) => {
                let lane = 8 * (self.target & 3);
                let written = self.line()?.write(self.target, self.size(), value >> lane);
                written.ok_or(ArmError::Dap(DapError::FaultResponse))?;
                self.advance();
            }
            RegisterAddress::ApRegister(_) => {}
        }
        Ok(())
    }

    fn jtag_sequence(&mut self, _: u8, _: bool, _: u64) -> Result<(), DebugProbeError> {
        Ok(())
    }

    fn swj_sequence(&mut self, _: u8, _: u64) -> Result<(), DebugProbeError> {
        Ok(())
    }

    fn swj_pins(&mut self, _: u32, _: u32, _: u32) -> Result<u32, DebugProbeError> {
        Ok(0xffff_ffff)
    }

    fn into_probe(self: Box<Self>) -> Box<dyn DebugProbe> {
        self
    }

    fn core_status_notification(&mut self, _: CoreStatus) -> Result<(), DebugProbeError> {
        Ok(())
    }
}

impl DapProbe for EmulatedProbe {}

impl DebugProbe for EmulatedProbe {
    fn get_name(&self) -> &'static str {
        "emulated"
    }

    fn speed_khz(&self) -> u32 {
        1000
    }

    fn set_speed(&mut self, speed_khz: u32) -> Result<u32, DebugProbeError> {
        Ok(speed_khz)
    }

    fn attach(&mut self) -> Result<(), DebugProbeError> {
        Ok(())
    }

    fn detach(&mut self) -> Result<(), probe_rs::Error> {
        Ok(())
    }

    fn target_reset(&mut self) -> Result<(), DebugProbeError> {
        self.chip.lock().reset();
        Ok(())
    }

    fn target_reset_assert(&mut self) -> Result<(), DebugProbeError> {
        Ok(())
    }

    fn target_reset_deassert(&mut self) -> Result<(), DebugProbeError> {
        Ok(())
    }

    fn select_protocol(&mut self, protocol: WireProtocol) -> Result<(), DebugProbeError> {
        if protocol == WireProtocol::Swd { Ok(()) } else { Err(DebugProbeError::UnsupportedProtocol(protocol)) }
    }

    fn active_protocol(&self) -> Option<WireProtocol> {
        Some(WireProtocol::Swd)
    }

    fn has_arm_interface(&self) -> bool {
        true
    }

    fn try_get_arm_debug_interface<'probe>(
        self: Box<Self>,
        sequence: Arc<dyn ArmDebugSequence>,
    ) -> Result<Box<dyn ArmDebugInterface + 'probe>, (Box<dyn DebugProbe>, ArmError)> {
        Ok(ArmCommunicationInterface::create(self, sequence, false))
    }

    fn into_probe(self: Box<Self>) -> Box<dyn DebugProbe> {
        self
    }

    fn try_as_dap_probe(&mut self) -> Option<&mut dyn DapProbe> {
        Some(self)
    }
}
