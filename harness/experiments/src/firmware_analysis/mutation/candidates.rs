//! Lists the mutants of a firmware image.

use super::disassembler::Disassembler;
use super::encoding::{Context, changes, compares_floats, compares_integers};
use super::mutant::{Change, Mutant};
use crate::firmware_analysis::code_map::CodeMap;
use crate::firmware_analysis::coverage::is_standard_library;
use crate::firmware_analysis::source_map::SourceMap;
use crate::firmware_analysis::thumb::{Instruction, it_condition, it_length};
use platebench_rig::Symbols;
use platebench_rig::symbols::SourceFrame;
use std::collections::{BTreeMap, BTreeSet};

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
) -> Vec<Mutant> {
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
                    mutants.extend(mutant.map(|mutant| Mutant { in_control_step: in_step(address), ..mutant }));
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
    let sources = SourceMap::new(symbols);
    let place = |&address: &u32| {
        let symbol = map.function_at(address).map_or_else(String::new, |function| function.name.clone());
        let frames = sources.frames(address);
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
    change: Change,
    place: &CandidatePlace,
) -> Option<Mutant> {
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
    Some(Mutant {
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
