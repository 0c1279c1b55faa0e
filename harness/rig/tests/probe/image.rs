//! Builds firmware images: an ELF with three functions, call frame information of one of them, and
//! optionally an RTT control block.

pub(crate) const FLASH: u32 = 0x0800_0000;
pub(crate) const RTT: u32 = 0x2000_0400;
pub(crate) const CONTROL_STEP: u32 = 0x0800_0200;
pub(crate) const MAIN_LOOP: u32 = 0x0800_0240;
pub(crate) const HANDLER: u32 = 0x0800_0280;
const FUNCTION_BYTES: u32 = 0x40;
/// Address of the word in flash that contains the number of the [`Program`].
pub(crate) const PROGRAM: u32 = 0x0800_0010;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Program {
    /// Runs the controller behind RTT.
    Controller = 1,
    /// Starts RTT, but never answers.
    Mute = 2,
    /// Starts RTT and traps at the first received byte.
    Traps = 3,
    /// Has a symbol for RTT, but never starts RTT.
    Asleep = 4,
    /// Runs the controller behind a serial port, without RTT.
    Port = 5,
    /// Traps at the first sample, without a report.
    PortTraps = 6,
    /// Traps at the first sample, with a report.
    PortReports = 7,
}

impl Program {
    pub(crate) fn from_word(word: u32) -> Option<Self> {
        use Program::{Asleep, Controller, Mute, Port, PortReports, PortTraps, Traps};
        let all = [Controller, Mute, Traps, Asleep, Port, PortTraps, PortReports];
        all.into_iter().find(|&program| program as u32 == word)
    }
}

pub(crate) struct ImageSpec {
    pub(crate) program: Program,
    pub(crate) rtt: bool,
    pub(crate) address: u32,
    pub(crate) bytes: usize,
    pub(crate) machine: u16,
}

impl Default for ImageSpec {
    fn default() -> Self {
        Self { program: Program::Controller, rtt: true, address: FLASH, bytes: 0x9000, machine: 40 }
    }
}

impl ImageSpec {
    pub(crate) fn elf(&self) -> Vec<u8> {
        let mut code: Vec<u8> = (0..self.bytes).map(|index| (index * 7 + index / 251) as u8).collect();
        let mut put = |at: u32, value: u32| {
            let at = (at - FLASH) as usize;
            code[at..at + 4].copy_from_slice(&value.to_le_bytes());
        };
        put(FLASH, 0x2002_0000);
        put(FLASH + 4, MAIN_LOOP | 1);
        put(PROGRAM, self.program as u32);
        // BL, which makes the next address a return address.
        put(MAIN_LOOP + 0xc, 0xf800_f000);
        assemble(self, &code)
    }
}

fn assemble(spec: &ImageSpec, code: &[u8]) -> Vec<u8> {
    const HEADERS: u32 = 52 + 32;
    let mut names = b"\0".to_vec();
    let mut symbols = vec![0; 16];
    let mut symbol = |name: &str, address: u32, size: u32, kind: u8, section: u16| {
        let at = names.len() as u32;
        names.extend_from_slice(name.as_bytes());
        names.push(0);
        for word in [at, address, size] {
            symbols.extend_from_slice(&word.to_le_bytes());
        }
        symbols.extend_from_slice(&[0x10 | kind, 0]);
        symbols.extend_from_slice(&section.to_le_bytes());
    };
    for (name, address) in [("control_step", CONTROL_STEP), ("main_loop", MAIN_LOOP), ("HardFault", HANDLER)] {
        symbol(name, address | 1, FUNCTION_BYTES, 2, 1);
    }
    if spec.rtt {
        symbol("_SEGGER_RTT", RTT, 120, 1, 2);
    }
    let titles = b"\0.text\0.bss\0.symtab\0.strtab\0.shstrtab\0.debug_frame\0";
    let frames = call_frames();
    let title = |name: &str| titles.windows(name.len()).position(|part| part == name.as_bytes()).unwrap() as u32;
    let at_code = HEADERS;
    let at_symbols = at_code + code.len() as u32;
    let at_names = at_symbols + symbols.len() as u32;
    let at_titles = at_names + names.len() as u32;
    let at_frames = at_titles + titles.len() as u32;
    let at_sections = (at_frames + frames.len() as u32).next_multiple_of(4);
    let length = |bytes: &[u8]| bytes.len() as u32;

    let mut elf = b"\x7fELF\x01\x01\x01\0\0\0\0\0\0\0\0\0".to_vec();
    push_half_words(&mut elf, &[2, spec.machine]);
    push_words(&mut elf, &[1, MAIN_LOOP | 1, 52, at_sections, 0x0500_0000]);
    push_half_words(&mut elf, &[52, 32, 1, 40, 7, 5]);
    push_words(&mut elf, &[1, at_code, spec.address, spec.address, length(code), length(code), 5, 4]);
    for part in [code, &symbols, &names, titles, &frames] {
        elf.extend_from_slice(part);
    }
    elf.resize(at_sections as usize, 0);
    push_words(&mut elf, &[0; 10]);
    push_words(&mut elf, &[title(".text"), 1, 6, spec.address, at_code, length(code), 0, 0, 4, 0]);
    push_words(&mut elf, &[title(".bss"), 8, 3, RTT, at_symbols, 120, 0, 0, 4, 0]);
    push_words(&mut elf, &[title(".symtab"), 2, 0, 0, at_symbols, length(&symbols), 4, 1, 4, 16]);
    push_words(&mut elf, &[title(".strtab"), 3, 0, 0, at_names, length(&names), 0, 0, 1, 0]);
    push_words(&mut elf, &[title(".shstrtab"), 3, 0, 0, at_titles, length(titles), 0, 0, 1, 0]);
    push_words(&mut elf, &[title(".debug_frame"), 1, 0, 0, at_frames, length(&frames), 0, 0, 1, 0]);
    elf
}

/// `control_step` has a frame of 16 bytes, whose last word is the return address.
fn call_frames() -> Vec<u8> {
    let mut frames = Vec::new();
    // Common information: version 4, addresses of 4 bytes, data alignment -4, return address in r14,
    // and at the function's start the frame address in r13.
    push_words(&mut frames, &[16, u32::MAX]);
    frames.extend_from_slice(&[4, 0, 4, 0, 1, 0x7c, 14, 0x0c, 13, 0, 0, 0]);
    // The frame address is r13 + 16; r14 is stored at the frame address - 4.
    push_words(&mut frames, &[16, 0, CONTROL_STEP, FUNCTION_BYTES]);
    frames.extend_from_slice(&[0x0e, 16, 0x8e, 1]);
    frames
}

fn push_words(to: &mut Vec<u8>, values: &[u32]) {
    for value in values {
        to.extend_from_slice(&value.to_le_bytes());
    }
}

fn push_half_words(to: &mut Vec<u8>, values: &[u16]) {
    for value in values {
        to.extend_from_slice(&value.to_le_bytes());
    }
}
