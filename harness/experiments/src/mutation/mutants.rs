//! Lists the mutants of a firmware image. Encodings: ARM DDI 0403E, sections A5.2, A5.3, A6.4, A7.3
//! and A7.7.

use crate::firmware_analysis::code_map::{CodeMap, Flow, Instruction, it_condition, it_length};
use crate::firmware_analysis::error::FirmwareAnalysisError;
use crate::firmware_analysis::is_standard_library;
use capstone::arch::arm::{ArchExtraMode, ArchMode};
use capstone::arch::{BuildsCapstone, BuildsCapstoneExtraMode};
use capstone::{Capstone, Error};
use platebench_rig::Symbols;
use platebench_rig::symbols::{SourceFrame, SourceLine};
use std::collections::{BTreeMap, BTreeSet};

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, strum::VariantArray, strum::Display, strum::IntoStaticStr,
)]
#[strum(const_into_str, serialize_all = "snake_case")]
pub enum MutationOperator {
    /// Exchanges addition and subtraction, or multiplication and division, or removes a change of
    /// sign.
    Arithmetic,
    #[strum(serialize = "negated condition")]
    Condition,
    /// Exchanges `<` and `≤`, or `>` and `≥`.
    #[strum(serialize = "comparison off by one")]
    Boundary,
    /// Changes an immediate value or a value in the literal pool.
    Constant,
    #[strum(serialize = "removed call")]
    RemovedCall,
    #[strum(serialize = "removed store")]
    RemovedStore,
    /// Removes `SSAT`, `USAT` and the conditional moves to which `clamp` of floats compiles.
    #[strum(serialize = "removed saturation")]
    RemovedSaturation,
}

impl MutationOperator {
    pub const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;

    pub const fn name(self) -> &'static str {
        self.into_str()
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CodeChange {
    pub(crate) operator: MutationOperator,
    pub(crate) address: u32,
    pub(crate) bytes: Vec<u8>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodeMutant {
    pub operator: MutationOperator,
    /// Address of the instruction whose effect changes.
    pub instruction: u32,
    /// Address of `original`, which is the instruction or its constant.
    pub address: u32,
    pub original: Vec<u8>,
    pub bytes: Vec<u8>,
    /// True if the instruction ran while the firmware answered a sample.
    pub in_control_step: bool,
    pub function: String,
    pub line: Option<SourceLine>,
    /// Disassembly of the instruction, or value of the constant.
    pub before: String,
    pub after: String,
}

#[derive(Debug, Clone, Default)]
pub struct MutantFilter {
    /// Parts of names of functions, including inlined ones. If both lists are empty, the filter
    /// selects the functions of the control step without those that the compiler adds, such as
    /// `memcpy`.
    pub functions: Vec<String>,
    /// Parts of paths of source files.
    pub files: Vec<String>,
}

/// Returns the selected mutants, sorted by address. `executed` is the result of
/// [`platebench_rig::EmulatedLink::executed_instructions`].
pub fn all_mutants(
    map: &CodeMap,
    symbols: &Symbols,
    disassembler: &Disassembler,
    filter: &MutantFilter,
    executed: &BTreeMap<u32, bool>,
) -> Vec<CodeMutant> {
    let places = places(map, symbols);
    let in_step = |address: &u32| executed.get(&map.leader_of(*address)) == Some(&true);
    let step_functions: BTreeSet<&str> =
        places.iter().filter(|(address, _)| in_step(address)).map(|(_, place)| &*place.function).collect();
    let mut context = Context::default();
    let mut conditional_left = 0;
    let mut seen = BTreeSet::new();
    let mut mutants = Vec::new();
    for (address, instruction) in &map.instructions {
        if map.leaders.contains(address) {
            context.compares_floats = false;
        }
        context.in_it_block = conditional_left > 0;
        let Some(place) = places.get(address) else { continue };
        if filter.selects(place, &step_functions) {
            for change in changes(map, instruction, context) {
                // Several instructions may load the same constant, whose changes are listed once.
                if seen.insert((change.address, change.bytes.clone())) {
                    let mutant = mutant(map, disassembler, instruction, change, place);
                    mutants.extend(mutant.map(|mutant| CodeMutant { in_control_step: in_step(address), ..mutant }));
                }
            }
        }
        conditional_left = match it_condition(instruction) {
            Some((_, mask)) => it_length(mask),
            None => conditional_left.saturating_sub(1),
        };
        context.compares_floats =
            compares_floats(instruction) || context.compares_floats && !compares_integers(instruction);
    }
    mutants
}

impl MutantFilter {
    fn selects(&self, place: &CandidatePlace, step_functions: &BTreeSet<&str>) -> bool {
        if self.functions.is_empty() && self.files.is_empty() {
            return !place.is_of_compiler && step_functions.contains(&*place.function);
        }
        let by_function = self.functions.iter().any(|part| place.names.iter().any(|name| name.contains(part)));
        let file = place.frame.as_ref().and_then(|frame| frame.line.as_ref()).map_or("", |line| &line.file);
        by_function || self.files.iter().any(|part| file.contains(part))
    }
}

struct CandidatePlace {
    /// True if no source line of the firmware or its dependencies belongs to the instruction.
    is_of_compiler: bool,
    /// The innermost function outside the standard library.
    function: String,
    frame: Option<SourceFrame>,
    /// Names of all functions that were inlined here, and of the symbol.
    names: Vec<String>,
}

fn places(map: &CodeMap, symbols: &Symbols) -> BTreeMap<u32, CandidatePlace> {
    let place = |&address: &u32| {
        let symbol = map.function_at(address).map_or_else(String::new, |function| function.name.clone());
        let frames = symbols.frames(address);
        let is_own = |frame: &&SourceFrame| frame.line.as_ref().is_some_and(|line| !is_standard_library(&line.file));
        let is_of_compiler =
            frames.iter().any(|frame| frame.line.is_some()) && !frames.iter().any(|frame| is_own(&frame));
        let frame = frames.iter().find(is_own).or(frames.last()).cloned();
        let names = frames.into_iter().map(|frame| frame.function).chain([symbol.clone()]).collect();
        let function = frame.as_ref().map_or(symbol, |frame| frame.function.clone());
        (address, CandidatePlace { is_of_compiler, function, frame, names })
    };
    map.instructions.keys().map(place).collect()
}

fn mutant(
    map: &CodeMap,
    disassembler: &Disassembler,
    instruction: &Instruction,
    change: CodeChange,
    place: &CandidatePlace,
) -> Option<CodeMutant> {
    let original = map.bytes(change.address, change.bytes.len())?.to_vec();
    let own = disassembler.text(instruction.address, &instruction.bytes())?;
    let (before, after) = if change.address == instruction.address {
        (own, disassembler.text(change.address, &change.bytes)?)
    } else {
        let value = |bytes: &[u8]| {
            let word = bytes.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes));
            if own.starts_with('v') { format!("{}", f32::from_bits(word)) } else { format!("{word:#x}") }
        };
        (format!("{own} = {}", value(&original)), format!("{own} = {}", value(&change.bytes)))
    };
    Some(CodeMutant {
        operator: change.operator,
        instruction: instruction.address,
        address: change.address,
        original,
        bytes: change.bytes,
        in_control_step: false,
        function: place.function.clone(),
        line: place.frame.as_ref().and_then(|frame| frame.line.clone()),
        before,
        after,
    })
}

pub struct Disassembler(Capstone);

impl Disassembler {
    pub fn new() -> Result<Self, FirmwareAnalysisError> {
        let built = Capstone::new().arm().mode(ArchMode::Thumb).extra_mode([ArchExtraMode::MClass].into_iter()).build();
        built.map(Self).map_err(|error: Error| FirmwareAnalysisError::Disassembler(error.to_string()))
    }

    /// Returns assembly such as `vadd.f32 s0, s1, s2`. `None` if `bytes` are no instruction.
    pub fn text(&self, address: u32, bytes: &[u8]) -> Option<String> {
        let instructions = self.0.disasm_count(bytes, u64::from(address), 1).ok()?;
        let instruction = instructions.iter().next().filter(|one| one.bytes().len() == bytes.len())?;
        Some(format!("{} {}", instruction.mnemonic()?, instruction.op_str().unwrap_or_default()).trim_end().to_owned())
    }
}

const NOP: u16 = 0xBF00;
const WIDE_NOP: (u16, Option<u16>) = (0xF3AF, Some(0x8000));
/// Instructions after a `MOVW` that may contain its `MOVT`. Compilers place both close together.
const MAX_MOVT_DISTANCE: usize = 8;
const SP: u16 = 13;
const PC: u16 = 15;

type Code = (u16, Option<u16>);

/// State that the preceding instructions leave.
#[derive(Debug, Clone, Copy, Default)]
struct Context {
    /// True if the processor's flags are those of a comparison of floats.
    compares_floats: bool,
    in_it_block: bool,
}

fn changes(map: &CodeMap, instruction: &Instruction, context: Context) -> Vec<CodeChange> {
    let nop = || if instruction.second.is_some() { WIDE_NOP } else { (NOP, None) };
    let is_clamp = context.in_it_block && context.compares_floats && is_move(instruction);
    let calls = matches!(instruction.flow(), Flow::Call(_));
    let codes = [
        (MutationOperator::Arithmetic, arithmetic(instruction)),
        (MutationOperator::Condition, negate(instruction)),
        (MutationOperator::Boundary, shift_boundary(instruction, context.compares_floats)),
        (MutationOperator::RemovedCall, calls.then(nop)),
        (MutationOperator::RemovedStore, is_store(instruction).then(nop)),
        (MutationOperator::RemovedSaturation, saturation(instruction).or_else(|| is_clamp.then(nop))),
    ];
    let codes = codes.into_iter().filter_map(|(operator, code)| Some((operator, code?)));
    let immediates = if is_half_of_address(map, instruction) { Vec::new() } else { immediates(instruction) };
    let immediates = immediates.into_iter().map(|code| (MutationOperator::Constant, code));
    let change = |(operator, (first, second)): (MutationOperator, Code)| {
        let changed = Instruction { address: instruction.address, first, second };
        CodeChange { operator, address: instruction.address, bytes: changed.bytes() }
    };
    codes.chain(immediates).map(change).chain(literals(map, instruction)).collect()
}

fn compares_floats(instruction: &Instruction) -> bool {
    (instruction.first, instruction.second) == (0xEEF1, Some(0xFA10))
}

fn compares_integers(instruction: &Instruction) -> bool {
    let first = instruction.first;
    match instruction.second {
        None => first & 0xF800 == 0x2800 || first & 0xFFC0 == 0x4280 || first & 0xFF00 == 0x4500,
        Some(second) => {
            let is_data = first & 0xFA00 == 0xF000 && second & 0x8000 == 0 || first & 0xFE00 == 0xEA00;
            is_data && first & 0x10 != 0
        }
    }
}

fn is_vfp(second: u16) -> bool {
    second & 0x0F10 == 0x0A00
}

fn arithmetic(instruction: &Instruction) -> Option<Code> {
    let first = instruction.first;
    let Some(second) = instruction.second else {
        return match first >> 11 {
            // Excludes `ADDS Rd, Rn, #0`, which is a move.
            0b00011 if first & 0x05C0 != 0x0400 => Some((first ^ 0x0200, None)),
            0b00110 | 0b00111 => Some((first ^ 0x0800, None)),
            _ => None,
        };
    };
    if first & 0xFF00 == 0xEE00 && is_vfp(second) {
        return vfp_arithmetic(first, second).map(|(first, second)| (first, Some(second)));
    }
    let (rn, rd) = (first & 0xF, second >> 8 & 0xF);
    if rn == SP || rn == PC || rd == PC {
        return None;
    }
    let is_modified_immediate = first & 0xFA00 == 0xF000 && second & 0x8000 == 0;
    let is_plain_immediate = matches!(first & 0xFBF0, 0xF200 | 0xF2A0) && second & 0x8000 == 0;
    let flip = match first >> 5 & 0xF {
        _ if is_plain_immediate => 0xA0,
        0b1000 | 0b1101 if is_modified_immediate || first & 0xFE00 == 0xEA00 => 0xA0,
        0b1010 | 0b1011 if is_modified_immediate || first & 0xFE00 == 0xEA00 => 0x20,
        _ => return None,
    };
    Some((first ^ flip, Some(second)))
}

fn vfp_arithmetic(first: u16, second: u16) -> Option<(u16, u16)> {
    match (first & 0xFFB0, second & 0x40 != 0) {
        // VADD and VSUB; VMLA and VMLS; VNMLS and VNMLA; VFNMS and VFNMA; VFMA and VFMS; VNMUL
        // becomes VMUL.
        (0xEE30 | 0xEE00 | 0xEE10 | 0xEE90 | 0xEEA0, _) | (0xEE20, true) => Some((first, second ^ 0x40)),
        // VMUL and VDIV.
        (0xEE20 | 0xEE80, false) => Some((first ^ 0xA0, second)),
        // VNEG and VABS become VMOV.
        (0xEEB0, true) if first & 0xFFBF == 0xEEB1 && second & 0x80 == 0 => Some((first ^ 1, second)),
        (0xEEB0, true) if first & 0xFFBF == 0xEEB0 && second & 0x80 != 0 => Some((first, second ^ 0x80)),
        _ => None,
    }
}

fn is_move(instruction: &Instruction) -> bool {
    let first = instruction.first;
    match instruction.second {
        None => first & 0xFF00 == 0x4600 || first & 0xF800 == 0x2000,
        Some(second) => {
            let vmov = first & 0xFFBF == 0xEEB0 && second & 0x0FD0 == 0x0A40;
            vmov || vmov_immediate(first, second) || float_literal(instruction).is_some()
        }
    }
}

fn vmov_immediate(first: u16, second: u16) -> bool {
    first & 0xFFB0 == 0xEEB0 && second & 0x0FF0 == 0x0A00
}

/// Replaces `SSAT` and `USAT` by `MOV.W Rd, Rn`.
fn saturation(instruction: &Instruction) -> Option<Code> {
    let (first, second) = (instruction.first, instruction.second?);
    let is_unshifted = second & 0xF0C0 == 0 && first & 0x0020 == 0;
    (matches!(first & 0xFFF0, 0xF300 | 0xF380) && is_unshifted).then_some((0xEA4F, Some(second & 0x0F00 | first & 0xF)))
}

/// False for pushes and for forms that also change the base register.
fn is_store(instruction: &Instruction) -> bool {
    let first = instruction.first;
    match instruction.second {
        None => {
            matches!(first & 0xFE00, 0x5000 | 0x5200 | 0x5400)
                || matches!(first & 0xF800, 0x6000 | 0x7000 | 0x8000 | 0x9000)
        }
        Some(second) => match first & 0xFFF0 {
            0xF880 | 0xF8A0 | 0xF8C0 => true,
            0xF800 | 0xF820 | 0xF840 => second & 0x0FC0 == 0 || second & 0x0F00 == 0x0C00,
            _ => first & 0xFF70 == 0xE940 || first & 0xFF30 == 0xED00 && second & 0x0E00 == 0x0A00,
        },
    }
}

fn immediates(instruction: &Instruction) -> Vec<Code> {
    let first = instruction.first;
    let Some(second) = instruction.second else {
        let next = if first & 0xFF == 0xFF { first - 1 } else { first + 1 };
        return if first & 0xF800 == 0x2000 { vec![(next, None)] } else { Vec::new() };
    };
    if vmov_immediate(first, second) {
        // One change is the sign, the other the first bit of the fraction, so that 1 becomes 1.5.
        return vec![(first ^ 8, Some(second)), (first, Some(second ^ 8))];
    }
    let is_mov = first & 0xFBEF == 0xF04F || first & 0xFBF0 == 0xF240;
    if is_mov && second & 0x8000 == 0 { vec![(first, Some(second ^ 1))] } else { Vec::new() }
}

/// True if the instruction loads the lower half of an address and a `MOVT` loads the upper half.
fn is_half_of_address(map: &CodeMap, instruction: &Instruction) -> bool {
    let Some((register, low)) = moved_immediate(instruction) else { return false };
    let next = map.instructions.range(instruction.address + 1..).map(|(_, next)| next).take(MAX_MOVT_DISTANCE);
    let upper = next.filter_map(|next| {
        let second = next.second.filter(|second| second & 0x8000 == 0 && second >> 8 & 0xF == register)?;
        (next.first & 0xFBF0 == 0xF2C0).then(|| split_immediate(next.first, second))
    });
    upper.take(1).any(|high| is_address(u32::from(high) << 16 | u32::from(low)))
}

/// Register and value of `MOVW`, or of `MOVS` with an immediate.
fn moved_immediate(instruction: &Instruction) -> Option<(u16, u16)> {
    let first = instruction.first;
    match instruction.second {
        None => (first & 0xF800 == 0x2000).then_some((first >> 8 & 7, first & 0xFF)),
        Some(second) => (first & 0xFBF0 == 0xF240 && second & 0x8000 == 0)
            .then(|| (second >> 8 & 0xF, split_immediate(first, second))),
    }
}

const fn split_immediate(first: u16, second: u16) -> u16 {
    (first & 0xF) << 12 | (first >> 10 & 1) << 11 | (second >> 12 & 7) << 8 | second & 0xFF
}

fn literal_address(instruction: &Instruction, adds: bool, offset: u32) -> u32 {
    let base = instruction.pc() & !3;
    if adds { base.wrapping_add(offset) } else { base.wrapping_sub(offset) }
}

fn float_literal(instruction: &Instruction) -> Option<u32> {
    let (first, second) = (instruction.first, instruction.second?);
    (first & 0xFF3F == 0xED1F && second & 0x0F00 == 0x0A00)
        .then(|| literal_address(instruction, first & 0x80 != 0, u32::from(second & 0xFF) * 4))
}

fn integer_literal(instruction: &Instruction) -> Option<u32> {
    let first = instruction.first;
    match instruction.second {
        None => (first & 0xF800 == 0x4800).then(|| literal_address(instruction, true, u32::from(first & 0xFF) * 4)),
        Some(second) => (first & 0xFF7F == 0xF85F && second >> 12 != PC)
            .then(|| literal_address(instruction, first & 0x80 != 0, u32::from(second & 0xFFF))),
    }
}

fn literals(map: &CodeMap, instruction: &Instruction) -> Vec<CodeChange> {
    let change = |address, word: u32| CodeChange {
        operator: MutationOperator::Constant,
        address,
        bytes: word.to_le_bytes().to_vec(),
    };
    if let Some(address) = float_literal(instruction) {
        let Some(word) = map.word(address) else { return Vec::new() };
        let value = f32::from_bits(word);
        if value == 0.0 {
            // A zero with the other sign has no effect.
            return vec![change(address, 1.0_f32.to_bits())];
        }
        let other = if value.is_finite() { 2.0 * value } else { 1.0 };
        return vec![change(address, word ^ 1 << 31), change(address, other.to_bits())];
    }
    let Some((address, word)) = integer_literal(instruction).and_then(|address| Some((address, map.word(address)?)))
    else {
        return Vec::new();
    };
    if is_address(word) { Vec::new() } else { vec![change(address, word.wrapping_add(1))] }
}

/// True for an address of flash, RAM, a peripheral or the processor.
fn is_address(word: u32) -> bool {
    matches!(word >> 24, 0x08 | 0x10 | 0x20 | 0x40 | 0x42 | 0x50 | 0xE0)
}

const CS: u16 = 2;
const CC: u16 = 3;
const MI: u16 = 4;
const PL: u16 = 5;
const HI: u16 = 8;
const LS: u16 = 9;
const GE: u16 = 10;
const LT: u16 = 11;
const GT: u16 = 12;
const LE: u16 = 13;
const ALWAYS: u16 = 14;

fn negate(instruction: &Instruction) -> Option<Code> {
    match (condition(instruction), instruction.second) {
        (Some(condition), _) => Some(with_condition(instruction, condition ^ 1)),
        (None, None) if instruction.first & 0xF500 == 0xB100 => Some((instruction.first ^ 0x0800, None)),
        _ => None,
    }
}

/// Moves equality to the other side, for example `<` to `≤`. After a comparison of floats, `MI` is
/// `<` and `PL` is `≥`.
fn shift_boundary(instruction: &Instruction, compares_floats: bool) -> Option<Code> {
    let shifted = match condition(instruction)? {
        GE => GT,
        GT => GE,
        LT => LE,
        LE => LT,
        CS => HI,
        HI => CS,
        CC => LS,
        LS => CC,
        MI if compares_floats => LS,
        PL if compares_floats => HI,
        _ => return None,
    };
    Some(with_condition(instruction, shifted))
}

fn condition(instruction: &Instruction) -> Option<u16> {
    let first = instruction.first;
    let condition = match instruction.second {
        None if first & 0xF000 == 0xD000 => first >> 8 & 0xF,
        None => it_condition(instruction)?.0,
        Some(second) if first & 0xF800 == 0xF000 && second & 0xD000 == 0x8000 => first >> 6 & 0xF,
        Some(_) => return None,
    };
    (condition < ALWAYS).then_some(condition)
}

fn with_condition(instruction: &Instruction, condition: u16) -> Code {
    let first = instruction.first;
    if let Some(second) = instruction.second {
        return (first & !0x03C0 | condition << 6, Some(second));
    }
    let Some((old, mask)) = it_condition(instruction) else { return (first & !0x0F00 | condition << 8, None) };
    // The mask contains bit 0 of each further condition, so these bits change too.
    let last = mask & mask.wrapping_neg();
    let mask = if (old ^ condition) & 1 == 1 { !mask & 0xF & !(last | (last - 1)) | last } else { mask };
    (first & 0xFF00 | condition << 4 | mask, None)
}
