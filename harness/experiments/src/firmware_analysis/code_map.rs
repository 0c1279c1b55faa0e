//! Divides the code of a firmware image into functions, instructions and basic blocks.
//! Encodings: ARM DDI 0403E (ARMv7-M), chapters A5 and A7.

use object::{Object, ObjectSection, ObjectSymbol, SectionKind};
use platebench_rig::Symbols;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// Addresses of the analysed code. Functions in RAM are not analysed.
const FLASH: Range<u64> = 0x0800_0000..0x0820_0000;

#[derive(Debug, Clone)]
pub struct CodeFunction {
    pub name: String,
    pub range: Range<u32>,
}

#[derive(Debug)]
pub struct CodeMap {
    /// Sorted by address, without overlap.
    pub functions: Vec<CodeFunction>,
    pub instructions: BTreeMap<u32, Instruction>,
    /// Addresses of the first instructions of all basic blocks. Control enters a block only there.
    pub leaders: BTreeSet<u32>,
    sections: Vec<(u32, Vec<u8>)>,
}

impl CodeMap {
    /// The map is empty if the file has no symbols.
    pub fn read(elf: &[u8], symbols: &Symbols) -> Self {
        let file = object::File::parse(elf).ok();
        let mut sections = Vec::new();
        if let Some(file) = &file {
            for section in file.sections() {
                let is_code = matches!(section.kind(), SectionKind::Text | SectionKind::ReadOnlyData);
                if let Ok(data) = section.data()
                    && is_code
                    && FLASH.contains(&section.address())
                {
                    sections.push((section.address() as u32, data.to_vec()));
                }
            }
        }
        let mapping = file.as_ref().map(mapping_symbols).unwrap_or_default();
        let mut map =
            Self { functions: functions(symbols), instructions: BTreeMap::new(), leaders: BTreeSet::new(), sections };
        for function in &map.functions {
            let mut address = function.range.start;
            while address < function.range.end {
                if let Some(code_starts) = data_end(&mapping, address) {
                    address = code_starts;
                    continue;
                }
                let Some(instruction) = map.bytes(address, 4).and_then(|code| Instruction::decode(address, code))
                else {
                    break;
                };
                map.instructions.insert(address, instruction);
                address = instruction.end();
            }
        }
        map.leaders = map.find_leaders();
        map
    }

    /// Returns fewer bytes at the end of a section.
    pub fn bytes(&self, address: u32, length: usize) -> Option<&[u8]> {
        self.sections.iter().find_map(|(start, bytes)| {
            let from = address.checked_sub(*start)? as usize;
            bytes.get(from..bytes.len().min(from + length)).filter(|bytes| !bytes.is_empty())
        })
    }

    pub fn word(&self, address: u32) -> Option<u32> {
        self.bytes(address, 4)?.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
    }

    pub fn function_at(&self, address: u32) -> Option<&CodeFunction> {
        let until = self.functions.partition_point(|function| function.range.start <= address);
        self.functions.get(until.checked_sub(1)?).filter(|function| function.range.contains(&address))
    }

    pub fn leader_of(&self, address: u32) -> u32 {
        self.leaders.range(..=address).next_back().copied().unwrap_or(address)
    }

    /// First instructions of the blocks to which conditional branches and tables of targets lead.
    pub fn branch_outcomes(&self) -> BTreeSet<u32> {
        let outcomes = self.instructions.values().flat_map(|instruction| match instruction.flow() {
            Flow::Conditional(target) => vec![target, instruction.end()],
            Flow::Table(entry) => self.table_targets(instruction, entry),
            Flow::Next | Flow::Jump(_) | Flow::Call(_) | Flow::Indirect => Vec::new(),
        });
        outcomes.filter(|outcome| self.leaders.contains(outcome)).collect()
    }

    fn find_leaders(&self) -> BTreeSet<u32> {
        let mut leaders: BTreeSet<u32> = self.functions.iter().map(|function| function.range.start).collect();
        let mut previous_end = None;
        for instruction in self.instructions.values() {
            if previous_end != Some(instruction.address) {
                leaders.insert(instruction.address);
            }
            previous_end = Some(instruction.end());
            let targets = match instruction.flow() {
                Flow::Next => continue,
                Flow::Conditional(target) | Flow::Jump(target) | Flow::Call(Some(target)) => vec![target],
                Flow::Call(None) | Flow::Indirect => Vec::new(),
                Flow::Table(entry) => self.table_targets(instruction, entry),
            };
            leaders.extend(targets);
            leaders.insert(instruction.end());
        }
        // Thumb addresses of functions and `switch` targets are odd words.
        let words =
            self.sections.iter().flat_map(|(_, bytes)| bytes.chunks_exact(4)).filter_map(|word| word.first_chunk());
        leaders.extend(words.map(|word| u32::from_le_bytes(*word)).filter(|word| word % 2 == 1).map(|word| word - 1));
        leaders.retain(|leader| self.instructions.contains_key(leader));
        leaders
    }

    fn table_targets(&self, instruction: &Instruction, entry: u32) -> Vec<u32> {
        let start = instruction.pc();
        let end = self.instructions.range(instruction.end()..).next().map_or(start, |(&address, _)| address);
        let entries = (start..end).step_by(entry as usize).filter_map(|at| {
            let bytes = self.bytes(at, entry as usize)?;
            Some(bytes.iter().rev().fold(0, |value, &byte| value << 8 | u32::from(byte)))
        });
        entries.map(|entry| start.wrapping_add(2 * entry)).collect()
    }
}

fn functions(symbols: &Symbols) -> Vec<CodeFunction> {
    let mut functions: Vec<CodeFunction> = Vec::new();
    for function in symbols.functions().iter().filter(|function| FLASH.contains(&function.address)) {
        let range = function.address as u32..function.end as u32;
        match functions.last_mut() {
            // The symbol is a second name of the function or a label in it.
            Some(last) if range.start < last.range.end => {}
            _ => functions.push(CodeFunction { name: function.name.clone(), range }),
        }
    }
    functions
}

/// `$t` begins code and `$d` data: ELF for the ARM Architecture, section 4.6.5.
fn mapping_symbols(file: &object::File<'_>) -> BTreeMap<u32, bool> {
    let symbols = file.symbols().filter_map(|symbol| {
        let name = symbol.name().ok()?;
        let is_data = name == "$d" || name.starts_with("$d.");
        (is_data || name == "$t" || name.starts_with("$t.")).then_some((symbol.address() as u32 & !1, is_data))
    });
    symbols.collect()
}

/// Address after the data at `address`. `None` if there is code at `address`.
fn data_end(mapping: &BTreeMap<u32, bool>, address: u32) -> Option<u32> {
    let is_data = mapping.range(..=address).next_back().is_some_and(|(_, is_data)| *is_data);
    let code = mapping.range(address + 1..).find(|(_, is_data)| !**is_data);
    is_data.then(|| code.map_or(u32::MAX, |(&address, _)| address))
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Instruction {
    pub address: u32,
    pub first: u16,
    /// Second halfword; `None` if the instruction has 16 bits.
    pub second: Option<u16>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Flow {
    Next,
    Conditional(u32),
    Jump(u32),
    Call(Option<u32>),
    /// A table of targets with entries of this many bytes follows.
    Table(u32),
    /// Control continues at an address in a register or on the stack.
    Indirect,
}

impl Instruction {
    /// `None` at the end of the code.
    pub(crate) fn decode(address: u32, code: &[u8]) -> Option<Self> {
        let halfword = |at: usize| Some(u16::from_le_bytes(*code.get(at..)?.first_chunk()?));
        let first = halfword(0)?;
        let second = if first >> 11 >= 0b11101 { Some(halfword(2)?) } else { None };
        Some(Self { address, first, second })
    }

    pub fn end(&self) -> u32 {
        self.address + if self.second.is_some() { 4 } else { 2 }
    }

    pub fn bytes(&self) -> Vec<u8> {
        let halfwords = [Some(self.first), self.second];
        halfwords.into_iter().flatten().flat_map(u16::to_le_bytes).collect()
    }

    /// Value of the program counter as the instruction reads it.
    pub(crate) fn pc(&self) -> u32 {
        self.address.wrapping_add(4)
    }

    pub(crate) fn flow(&self) -> Flow {
        match self.second {
            None => self.narrow_flow(),
            Some(second) => self.wide_flow(second),
        }
    }

    fn target(&self, offset: u32, bits: u32) -> u32 {
        let shift = 32 - bits;
        self.pc().wrapping_add(((offset << shift).cast_signed() >> shift).cast_unsigned())
    }

    fn narrow_flow(&self) -> Flow {
        let first = self.first;
        let low = u32::from(first);
        match first >> 12 {
            0b1101 if first >> 8 & 0xF == 0xE => Flow::Indirect,
            0b1101 if first >> 8 & 0xF < 0xE => Flow::Conditional(self.target((low & 0xFF) << 1, 9)),
            0b1110 => Flow::Jump(self.target((low & 0x7FF) << 1, 12)),
            0b1011 if first & 0x0500 == 0x0100 => {
                Flow::Conditional(self.pc().wrapping_add((low >> 9 & 1) << 6 | (low >> 3 & 0x1F) << 1))
            }
            0b1011 if first & 0x0F00 == 0x0D00 => Flow::Indirect,
            0b0100 if first & 0x0F80 == 0x0780 => Flow::Call(None),
            0b0100 if first & 0x0F80 == 0x0700 || first & 0x0D87 == 0x0487 => Flow::Indirect,
            _ => Flow::Next,
        }
    }

    fn wide_flow(&self, second: u16) -> Flow {
        let (first, high, low) = (self.first, u32::from(self.first), u32::from(second));
        if first & 0xFFF0 == 0xE8D0 && second & 0xFFE0 == 0xF000 {
            return Flow::Table(1 + (low >> 4 & 1));
        }
        let loads_pc =
            (first & 0xFE50 == 0xE810 && second & 0x8000 != 0) || (first & 0xFF70 == 0xF850 && second >> 12 == 15);
        if loads_pc {
            return Flow::Indirect;
        }
        if first & 0xF800 != 0xF000 || second & 0x8000 == 0 {
            return Flow::Next;
        }
        let sign = high >> 10 & 1;
        let (j1, j2) = (low >> 13 & 1, low >> 11 & 1);
        let far = || {
            let (i1, i2) = (1 ^ j1 ^ sign, 1 ^ j2 ^ sign);
            self.target(sign << 24 | i1 << 23 | i2 << 22 | (high & 0x3FF) << 12 | (low & 0x7FF) << 1, 25)
        };
        match (second >> 14 & 1, second >> 12 & 1) {
            (1, 1) => Flow::Call(Some(far())),
            (0, 1) => Flow::Jump(far()),
            (0, 0) if high >> 6 & 0xF < 0xE => Flow::Conditional(
                self.target(sign << 20 | j2 << 19 | j1 << 18 | (high & 0x3F) << 12 | (low & 0x7FF) << 1, 21),
            ),
            _ => Flow::Next,
        }
    }
}

/// Condition and mask of an `IT`. `None` for hints, which share the encoding, and others.
pub(crate) fn it_condition(instruction: &Instruction) -> Option<(u16, u16)> {
    let is_it = instruction.first & 0xFF00 == 0xBF00 && instruction.first & 0xF != 0;
    is_it.then_some((instruction.first >> 4 & 0xF, instruction.first & 0xF))
}

/// Number of instructions that an `IT` with this mask makes conditional.
pub(crate) fn it_length(mask: u16) -> u32 {
    4 - mask.trailing_zeros().min(3)
}
