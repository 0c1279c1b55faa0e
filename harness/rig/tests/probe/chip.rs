//! Emulates an STM32F407 for a debugger: memory map, debug registers of a Cortex-M4, flash.
//! Executes no instruction: programs act when they are started at their entry point.

use crate::image::{CONTROL_STEP, HANDLER, MAIN_LOOP, PROGRAM, Program};
use crate::rtt_buffers::RttBuffers;
use platebench_controller::Device;
use platebench_wire::{FaultReport, Identity, Message, Packet};
use probe_rs::config::Registry;
use probe_rs::flashing::FlashAlgorithm;
use std::collections::HashMap;
use std::time::Instant;

pub(crate) const CHIP: &str = "STM32F407VG";
const FLASH: u32 = 0x0800_0000;
const FLASH_BYTES: usize = 0x10_0000;
const RAM: u32 = 0x2000_0000;
const RAM_BYTES: usize = 0x2_0000;
const SP: usize = 13;
const LR: usize = 14;
const PC: usize = 15;
const XPSR: usize = 16;

#[expect(clippy::struct_excessive_bools, reason = "each is an independent fault")]
pub(crate) struct Chip {
    pub(crate) idcode: u32,
    pub(crate) resets: u32,
    pub(crate) erased_sectors: u32,
    pub(crate) programmed_pages: u32,
    /// Address of a byte. Each programmed page flips one bit of this byte.
    pub(crate) failing_byte: Option<u32>,
    pub(crate) algorithm_hangs: bool,
    pub(crate) failing_accesses: u32,
    pub(crate) memory_hangs: bool,
    pub(crate) watchdog_resets_when_halted: bool,
    pub(crate) device: Device,
    pub(crate) lost_serial_chunks: u32,
    flash: Vec<u8>,
    ram: Vec<u8>,
    registers: HashMap<u32, u32>,
    core: [u32; 17],
    psp: u32,
    dcrdr: u32,
    control: u32,
    halted: bool,
    reset_seen: bool,
    stepped_from: Option<u32>,
    program: Option<Program>,
    algorithm: FlashAlgorithm,
    since: Instant,
}

impl Chip {
    pub(crate) fn new() -> Self {
        let target = Registry::from_builtin_families().get_target_by_name(CHIP).unwrap();
        let raw = target.flash_algorithms.iter().find(|algorithm| algorithm.name == "stm32f4xx_1024").unwrap();
        let algorithm = FlashAlgorithm::assemble_from_raw_with_core(raw, "main", &target).unwrap();
        Self {
            idcode: 0x1007_6413,
            resets: 0,
            erased_sectors: 0,
            programmed_pages: 0,
            failing_byte: None,
            algorithm_hangs: false,
            failing_accesses: 0,
            memory_hangs: false,
            watchdog_resets_when_halted: false,
            device: device(),
            lost_serial_chunks: 0,
            flash: vec![0xff; FLASH_BYTES],
            ram: vec![0; RAM_BYTES],
            registers: HashMap::new(),
            core: [0; 17],
            psp: 0,
            dcrdr: 0,
            control: 0,
            halted: false,
            reset_seen: false,
            stepped_from: None,
            program: None,
            algorithm,
            since: Instant::now(),
        }
    }

    pub(crate) fn is_halted(&self) -> bool {
        self.halted
    }

    pub(crate) fn flash_byte(&mut self, address: u32) -> &mut u8 {
        &mut self.flash[(address - FLASH) as usize]
    }

    pub(crate) fn read(&mut self, address: u32, size: u32) -> Option<u32> {
        self.run_firmware();
        if address >= 0xe000_0000 {
            return Some(self.read_register(address));
        }
        let mut value = [0; 4];
        for offset in 0..size {
            value[offset as usize] = *self.byte(address + offset)?;
        }
        Some(u32::from_le_bytes(value))
    }

    pub(crate) fn write(&mut self, address: u32, size: u32, value: u32) -> Option<()> {
        if address >= 0xe000_0000 {
            self.write_register(address, value);
            return Some(());
        }
        // Only the flash algorithm can write flash.
        (RAM..RAM + RAM_BYTES as u32).contains(&address).then_some(())?;
        for offset in 0..size {
            *self.byte(address + offset)? = value.to_le_bytes()[offset as usize];
        }
        self.run_firmware();
        Some(())
    }

    fn byte(&mut self, address: u32) -> Option<&mut u8> {
        match address {
            FLASH..RAM => self.flash.get_mut((address - FLASH) as usize),
            RAM.. => self.ram.get_mut((address - RAM) as usize),
            _ => None,
        }
    }

    pub(crate) fn word(&mut self, address: u32) -> u32 {
        u32::from_le_bytes([0, 1, 2, 3].map(|offset| *self.byte(address + offset).unwrap()))
    }

    pub(crate) fn set_word(&mut self, address: u32, value: u32) {
        for (offset, byte) in (0..).zip(value.to_le_bytes()) {
            *self.byte(address + offset).unwrap() = byte;
        }
    }

    fn read_register(&mut self, address: u32) -> u32 {
        match address {
            0xe004_2000 => self.idcode,
            0xe000_edf0 => {
                let reset = u32::from(std::mem::take(&mut self.reset_seen)) << 25;
                reset | 1 << 16 | u32::from(self.halted) << 17 | self.control
            }
            0xe000_edf8 => self.dcrdr,
            // The chip has six hardware breakpoints (FP_CTRL, first revision).
            0xe000_2000 => 6 << 4 | self.registers.get(&address).copied().unwrap_or(0) & 1,
            0xe000_ef40 => 0x1011_0021,
            0xe000_ed00 => 0x410f_c241,
            _ => self.registers.get(&address).copied().unwrap_or(0),
        }
    }

    fn write_register(&mut self, address: u32, value: u32) {
        match address {
            0xe000_edf0 if value >> 16 == 0xa05f => self.debug_control(value & 0xf),
            0xe000_edf4 => self.transfer(value),
            0xe000_edf8 => self.dcrdr = value,
            0xe000_ed0c if value >> 16 == 0x05fa && value & 4 != 0 => self.reset(),
            0xe000_ed30 => *self.registers.entry(address).or_default() &= !value,
            _ => {
                self.registers.insert(address, value);
            }
        }
    }

    fn transfer(&mut self, selector: u32) {
        let register = match selector & 0x7f {
            index @ 0..=16 => &mut self.core[index as usize],
            17 => &mut self.core[SP],
            18 => &mut self.psp,
            _ => return,
        };
        if selector & 1 << 16 == 0 { self.dcrdr = *register } else { *register = self.dcrdr }
    }

    fn debug_control(&mut self, bits: u32) {
        const HALT: u32 = 2;
        const STEP: u32 = 4;
        self.control = bits;
        if bits & 1 == 0 {
            self.halted = false;
        } else if bits & HALT != 0 {
            let running = !self.halted;
            self.stop(1);
            if running && self.watchdog_resets_when_halted {
                self.registers.remove(&0xe000_ed04);
            }
        } else if bits & STEP != 0 {
            self.stepped_from = Some(self.core[PC] & !1);
            self.core[PC] = self.core[PC].wrapping_add(2);
            self.stop(1);
        } else if self.halted {
            self.run();
        }
    }

    fn stop(&mut self, reason: u32) {
        self.halted = true;
        self.control |= 3;
        *self.registers.entry(0xe000_ed30).or_default() |= reason;
    }

    pub(crate) fn reset(&mut self) {
        self.resets += 1;
        self.reset_seen = true;
        let catch = self.registers.get(&0xe000_edfc).copied().unwrap_or(0) & 1 != 0;
        self.registers.retain(|&address, _| address == 0xe000_edfc);
        self.core = [0; 17];
        self.core[SP] = self.word(FLASH);
        self.core[PC] = self.word(FLASH + 4) & !1;
        self.core[XPSR] = 1 << 24;
        self.control &= 1;
        self.halted = false;
        self.stepped_from = None;
        self.program = None;
        self.device = device();
        if catch { self.stop(8) } else { self.boot() }
    }

    fn boot(&mut self) {
        self.program = Program::from_word(self.word(PROGRAM));
        if matches!(self.program, Some(Program::Controller | Program::Mute | Program::Traps)) {
            RttBuffers::start(self);
        }
    }

    fn run(&mut self) {
        self.halted = false;
        let entry = u64::from(self.stepped_from.take().unwrap_or(self.core[PC] & !1));
        if entry == u64::from(self.word(FLASH + 4) & !1) {
            return self.boot();
        }
        // Bit 0 of an entry point is the Thumb bit.
        let algorithm = &self.algorithm;
        let (program, erase) = (algorithm.pc_program_page & !1, algorithm.pc_erase_sector & !1);
        let [init, uninit] = [algorithm.pc_init, algorithm.pc_uninit].map(|entry| entry.map_or(0, |entry| entry & !1));
        if ![init, uninit, program, erase].contains(&entry) || self.algorithm_hangs {
            return;
        }
        let [address, size, buffer, ..] = self.core;
        if entry == erase {
            self.erase(address);
        } else if entry == program {
            self.program_page(address, size, buffer);
        }
        self.core[0] = 0;
        // The algorithm returns to the breakpoint of the flash loader.
        self.core[PC] = self.core[LR] & !1;
        self.stop(2);
    }

    fn erase(&mut self, address: u32) {
        let size = match address - FLASH {
            0..0x1_0000 => 0x4000,
            0x1_0000..0x2_0000 => 0x1_0000,
            _ => 0x2_0000,
        };
        self.erased_sectors += 1;
        (address..address + size).for_each(|address| *self.flash_byte(address) = 0xff);
    }

    fn program_page(&mut self, address: u32, size: u32, buffer: u32) {
        self.programmed_pages += 1;
        for offset in 0..size {
            let byte = *self.byte(buffer + offset).unwrap();
            *self.flash_byte(address + offset) &= byte;
        }
        if let Some(weak) = self.failing_byte {
            *self.flash_byte(weak) ^= 0x10;
        }
    }

    fn run_firmware(&mut self) {
        if !self.is_running() {
            return;
        }
        let Some(program @ (Program::Controller | Program::Traps)) = self.program else { return };
        let received = RttBuffers::read_down(self);
        if received.is_empty() {
            return;
        }
        if program == Program::Traps {
            return self.trap();
        }
        let now = self.since.elapsed().as_micros() as u32;
        let mut answer = Vec::new();
        self.device.receive(&received, now, |frame| answer.extend_from_slice(frame));
        RttBuffers::write_up(self, &answer);
    }

    fn is_running(&self) -> bool {
        let in_a_handler = self.registers.get(&0xe000_ed04).is_some_and(|active| active & 0x1ff != 0);
        !self.halted && !in_a_handler
    }

    pub(crate) fn serial_port(&mut self, received: &[u8]) -> Vec<u8> {
        let program = self.program.filter(|_| self.is_running());
        let Some(program @ (Program::Port | Program::PortTraps | Program::PortReports)) = program else {
            return Vec::new();
        };
        if self.lost_serial_chunks > 0 {
            self.lost_serial_chunks -= 1;
            return Vec::new();
        }
        let now = self.since.elapsed().as_micros() as u32;
        let mut answer = Vec::new();
        self.device.receive(received, now, |frame| answer.extend_from_slice(frame));
        if program != Program::Port && self.device.output().drive_vpp > 0.0 {
            answer.clear();
            self.trap();
            if program == Program::PortReports {
                let report = FaultReport {
                    code: 1,
                    pc: CONTROL_STEP + 0x12,
                    lr: 0x0800_0333,
                    cfsr: 0x8200,
                    address: 0x4000_1000,
                };
                answer.extend_from_slice(Packet { sequence: 0, message: Message::Fault(report) }.encode().as_bytes());
            }
        }
        answer
    }

    /// Traps with a data bus error at `0x4000_1000` in `control_step`, called from `main_loop`.
    fn trap(&mut self) {
        for (address, value) in
            [(0xe000_ed04, 3), (0xe000_ed28, 0x8200), (0xe000_ed2c, 1 << 30), (0xe000_ed38, 0x4000_1000)]
        {
            self.registers.insert(address, value);
        }
        let stack = RAM + 0x1_f000;
        let pushed = [0x77, 0xffff_fff9];
        let stacked = [1, 2, 3, 4, 12, 0x0800_0333, CONTROL_STEP + 0x12, 1 << 24];
        let called = [0, 0, 0, (MAIN_LOOP + 0x10) | 1];
        for (index, word) in (0..).zip(pushed.into_iter().chain(stacked).chain(called)) {
            self.set_word(stack + 4 * index, word);
        }
        self.core[SP] = stack;
        self.core[LR] = 0xffff_fff9;
        self.core[PC] = HANDLER + 8;
    }
}

fn device() -> Device {
    Device::new(Identity {
        build: [9; 8],
        chip: 0x1007_6413,
        unique: [7; 12],
        name: *b"emulated-board\0\0",
        ..platebench_test_kit::IDENTITY
    })
}
