//! Divides the code of a firmware image into functions, instructions and basic blocks.

use crate::firmware_analysis::thumb::{Flow, Instruction};
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
