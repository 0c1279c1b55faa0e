//! Finds the function and the source line of an address in a firmware image, and steps from a function
//! to its caller by the call frame information (CFI), section `.debug_frame` (DWARF 5, chapter 6.4;
//! register numbers: DWARF for the ARM Architecture, 4.1).

use addr2line::Context;
use gimli::{
    BaseAddresses, CfaRule, DebugFrame, Dwarf, EndianArcSlice, Reader as _, Register, RegisterRule, RunTimeEndian,
    SectionId, UnwindContext, UnwindSection as _,
};
use object::{CompressionFormat, Object, ObjectSection, ObjectSymbol, SymbolKind};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

type DebugSlice = EndianArcSlice<RunTimeEndian>;

/// Largest number of names of a function. Compilers merge identical functions, which then have
/// several names.
const MAX_ALIASES: usize = 8;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodeLocation {
    pub address: u32,
    pub symbol: Option<String>,
    /// Source file and line; `None` without debug information.
    pub line: Option<String>,
}

impl fmt::Display for CodeLocation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{:#010x}", self.address)?;
        if let Some(symbol) = &self.symbol {
            write!(formatter, " in {symbol}")?;
        }
        match &self.line {
            Some(line) => write!(formatter, " ({line})"),
            None => Ok(()),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Function {
    pub address: u64,
    pub end: u64,
    pub name: String,
}

/// A function that contains an instruction, and the line of the instruction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SourceFrame {
    pub function: String,
    pub line: Option<SourceLine>,
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SourceLine {
    pub file: String,
    pub line: u32,
}

pub struct Symbols {
    functions: Vec<Function>,
    all: Vec<(String, u64)>,
    lines: Option<Context<DebugSlice>>,
    /// Relative folders in which units were compiled.
    build_folders: BTreeSet<String>,
    call_frames: CallFrames,
    has_compressed_lines: bool,
}

impl Symbols {
    /// If `elf` has no symbols, locations contain only addresses.
    pub fn read(elf: &[u8]) -> Self {
        let file = object::File::parse(elf).ok();
        let file = file.as_ref();
        let named: Vec<_> = match file {
            Some(file) => file.symbols().filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol))).collect(),
            None => Vec::new(),
        };
        let load = |id| Ok::<_, gimli::Error>(section(file, id));
        let dwarf = Dwarf::load(load).ok();
        Self {
            functions: functions(&named),
            all: named.into_iter().map(|(name, symbol)| (name, symbol.address())).collect(),
            build_folders: dwarf.as_ref().map(relative_build_folders).unwrap_or_default(),
            lines: dwarf.and_then(|dwarf| Context::from_dwarf(dwarf).ok()),
            call_frames: CallFrames::new(section(file, SectionId::DebugFrame)),
            has_compressed_lines: file.is_some_and(has_compressed_lines),
        }
    }

    pub(crate) fn address(&self, name: &str) -> Option<u64> {
        self.all.iter().find(|(other, _)| other == name).map(|&(_, address)| address)
    }

    pub(crate) fn has_section(elf: &[u8], name: &str) -> bool {
        object::File::parse(elf).is_ok_and(|file| file.section_by_name(name).is_some())
    }

    /// Address and size in bytes of a variable. `name` may be mangled or demangled, or its last
    /// part.
    pub(crate) fn variable(elf: &[u8], name: &str) -> Option<(u32, u32)> {
        let file = object::File::parse(elf).ok()?;
        let named = |symbol: &object::Symbol<'_, '_>| {
            symbol.name().is_ok_and(|own| {
                let demangled = format!("{:#}", rustc_demangle::demangle(own));
                own == name || demangled == name || demangled.rsplit("::").next() == Some(name)
            })
        };
        let symbol =
            file.symbols().find(|symbol| symbol.kind() == SymbolKind::Data && symbol.size() > 0 && named(symbol));
        symbol.map(|symbol| (symbol.address() as u32, symbol.size() as u32))
    }

    pub(crate) fn panic_handler(&self) -> Option<u64> {
        self.functions
            .iter()
            .find(|function| function.name.ends_with("rust_begin_unwind"))
            .map(|function| function.address)
    }

    pub(crate) fn call_frames(&self) -> &CallFrames {
        &self.call_frames
    }

    pub(crate) fn is_code(&self, address: u64) -> bool {
        self.function(address).is_some()
    }

    fn function(&self, address: u64) -> Option<&Function> {
        let until = self.functions.partition_point(|function| function.address <= address);
        let before = self.functions.get(..until)?.iter().rev();
        before.take(MAX_ALIASES).find(|function| address < function.end)
    }

    /// True if the line table is compressed. It is not read then.
    pub fn has_compressed_lines(&self) -> bool {
        self.has_compressed_lines
    }

    /// Sorted by address.
    pub fn functions(&self) -> &[Function] {
        &self.functions
    }

    /// Functions inlined at `address`, innermost first, then the function itself. Empty without
    /// debug information.
    pub fn frames(&self, address: u32) -> Vec<SourceFrame> {
        let Some(lines) = &self.lines else { return Vec::new() };
        let Ok(mut frames) = lines.find_frames(u64::from(address)).skip_all_loads() else { return Vec::new() };
        let mut found = Vec::new();
        while let Ok(Some(frame)) = frames.next() {
            let name = frame.function.as_ref().and_then(|function| function.demangle().ok());
            // With split DWARF, the names are in another file. Inlined functions then have no frame.
            let name = name.map(|name| strip_hash(&name)).or_else(|| Some(self.function(address.into())?.name.clone()));
            let line = frame.location.and_then(|location| Some((location.file?, location.line?)));
            found.push(SourceFrame {
                function: name.unwrap_or_else(|| "?".to_owned()),
                line: line.map(|(file, line)| SourceLine { file: self.source_name(file), line }),
            });
        }
        found
    }

    /// The name of a source file, from the image alone. A compiler that shortens paths writes the
    /// folder of the unit in front of a path that is already complete: `a/wire/a/wire/src/x.rs`.
    fn source_name(&self, file: &str) -> String {
        let first = |path: &str| path.split('/').next().map(str::to_owned);
        let is_complete = |rest: &&str| self.build_folders.iter().any(|folder| first(folder) == first(rest));
        let rests = self.build_folders.iter().filter_map(|folder| file.strip_prefix(folder)?.strip_prefix('/'));
        let name = rests.filter(is_complete).min_by_key(|rest| rest.len()).unwrap_or(file);
        let mut parts: Vec<&str> = Vec::new();
        for part in name.split('/') {
            match (part, parts.last()) {
                (".", _) => {}
                ("..", Some(last)) if !last.is_empty() && *last != ".." => drop(parts.pop()),
                _ => parts.push(part),
            }
        }
        parts.join("/")
    }

    /// Returns function and line. The function's name includes the innermost inlined function.
    pub(crate) fn locate(&self, address: u32) -> CodeLocation {
        let mut symbol = self.function(u64::from(address)).map(|function| function.name.clone());
        // The line table keeps removed functions at address 0. Lines outside known functions are
        // therefore invalid.
        let mut frames = if symbol.is_some() || self.functions.is_empty() { self.frames(address) } else { Vec::new() };
        // The innermost line outside the standard library is in the firmware's own code.
        let mut lines = frames.iter().filter_map(|frame| frame.line.as_ref());
        let line = lines.clone().find(|line| !line.file.contains("/library/")).or_else(|| lines.next());
        let line = line.map(|line| format!("{}:{}", line.file, line.line));
        frames.pop();
        let innermost = frames.iter().map(|frame| &frame.function).find(|name| !name.starts_with("core::"));
        if let (Some(symbol), Some(innermost)) = (&mut symbol, innermost) {
            *symbol = format!("{innermost} inlined into {symbol}");
        }
        CodeLocation { address, symbol, line }
    }
}

/// A function without a size, such as one in assembly code, ends at the next function.
fn functions(named: &[(String, object::Symbol<'_, '_>)]) -> Vec<Function> {
    let defined = named.iter().filter(|(_, symbol)| symbol.kind() == SymbolKind::Text && symbol.is_definition());
    let function = |(name, symbol): &(String, object::Symbol<'_, '_>)| {
        // Bit 0 marks Thumb code and is no part of the address.
        let address = symbol.address() & !1;
        Function { address, end: address + symbol.size(), name: format!("{:#}", rustc_demangle::demangle(name)) }
    };
    let mut functions: Vec<_> = defined.map(function).collect();
    functions.sort_by(|a, b| (a.address, a.end, &a.name).cmp(&(b.address, b.end, &b.name)));
    fill_missing_ends(&mut functions);
    functions
}

fn fill_missing_ends(functions: &mut [Function]) {
    let mut next = None;
    let mut same = None;
    for function in functions.iter_mut().rev() {
        if same.is_some_and(|same| same != function.address) {
            next = same;
        }
        same = Some(function.address);
        if function.end == function.address {
            function.end = next.unwrap_or(function.address + 2);
        }
    }
}

fn relative_build_folders(dwarf: &Dwarf<DebugSlice>) -> BTreeSet<String> {
    let mut folders = BTreeSet::new();
    let mut headers = dwarf.units();
    while let Ok(Some(header)) = headers.next() {
        let folder = dwarf.unit(header).ok().and_then(|unit| unit.comp_dir);
        let folder = folder.and_then(|folder| Some(folder.to_string_lossy().ok()?.into_owned()));
        folders.extend(folder.filter(|folder| !folder.starts_with('/') && !folder.is_empty()));
    }
    folders
}

fn section(file: Option<&object::File<'_>>, id: SectionId) -> DebugSlice {
    let data = file.and_then(|file| file.section_by_name(id.name())?.uncompressed_data().ok()).unwrap_or_default();
    EndianArcSlice::new(Arc::from(&*data), RunTimeEndian::Little)
}

fn has_compressed_lines(file: &object::File<'_>) -> bool {
    let compressed = |section: object::Section<'_, '_>| {
        section.compressed_file_range().is_ok_and(|range| range.format != CompressionFormat::None)
    };
    file.section_by_name(SectionId::DebugLine.name()).is_some_and(compressed)
}

fn strip_hash(name: &str) -> String {
    match name.rsplit_once("::h") {
        Some((front, hash)) if hash.len() == 16 && hash.bytes().all(|byte| byte.is_ascii_hexdigit()) => {
            front.to_owned()
        }
        _ => name.to_owned(),
    }
}

const FIRST_SAVED: u16 = 4;
const SP: u16 = 13;
const LR: u16 = 14;
const ADDRESS_BYTES: u8 = 4;

/// Core registers that decide where a function's caller is. `None` if the value is not known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct FrameRegisters {
    pub(crate) sp: u32,
    pub(crate) lr: Option<u32>,
    /// Registers r4 to r11, which a function preserves.
    pub(crate) saved: [Option<u32>; 8],
}

impl FrameRegisters {
    pub(crate) fn get(&self, register: u16) -> Option<u32> {
        match register {
            SP => Some(self.sp),
            LR => self.lr,
            _ => *self.saved.get(usize::from(register.checked_sub(FIRST_SAVED)?))?,
        }
    }
}

/// The caller's registers after the return.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Caller {
    pub(crate) return_address: u32,
    pub(crate) registers: FrameRegisters,
    /// Register from which the address of the frame follows.
    pub(crate) base: u16,
}

pub(crate) struct CallFrames(DebugFrame<EndianArcSlice<RunTimeEndian>>);

impl CallFrames {
    pub(crate) fn new(section: EndianArcSlice<RunTimeEndian>) -> Self {
        let mut frames = DebugFrame::from(section);
        frames.set_address_size(ADDRESS_BYTES);
        Self(frames)
    }

    /// Returns the caller of the function that contains `address`. `None` if the image has no CFI
    /// for it, or if a register or a word that the rules need is not known.
    pub(crate) fn caller(
        &self,
        address: u32,
        registers: &FrameRegisters,
        word: impl Fn(u32) -> Option<u32>,
    ) -> Option<Caller> {
        let mut context = UnwindContext::new();
        let row = self
            .0
            .unwind_info_for_address(
                &BaseAddresses::default(),
                &mut context,
                address.into(),
                DebugFrame::cie_from_offset,
            )
            .ok()?;
        let CfaRule::RegisterAndOffset { register: base, offset } = row.cfa() else { return None };
        let at = |from: u32, offset: i64| u32::try_from(i64::from(from) + offset).ok();
        let frame = at(registers.get(base.0)?, *offset)?;
        let value = |register: u16| match row.register(Register(register)) {
            // By convention, a function preserves these registers.
            None | Some(RegisterRule::SameValue) => registers.get(register),
            Some(RegisterRule::Offset(offset)) => word(at(frame, offset)?),
            Some(RegisterRule::ValOffset(offset)) => at(frame, offset),
            Some(RegisterRule::Register(other)) => registers.get(other.0),
            Some(_) => None,
        };
        let mut saved = [None; 8];
        for (register, slot) in (FIRST_SAVED..).zip(&mut saved) {
            *slot = value(register);
        }
        let registers = FrameRegisters { sp: frame, lr: None, saved };
        Some(Caller { return_address: value(LR)?, registers, base: base.0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[inline(never)]
    fn known_function() -> u32 {
        std::hint::black_box(std::process::id())
    }

    fn own_symbols() -> Symbols {
        Symbols::read(&std::fs::read(std::env::current_exe().unwrap()).unwrap())
    }

    #[rstest]
    #[case::complete("a/wire/a/wire/src/x.rs", "a/wire/src/x.rs")]
    #[case::of_another_unit("a/wire/a/law/src/x.rs", "a/law/src/x.rs")]
    #[case::below_the_folder("a/wire/src/x.rs", "a/wire/src/x.rs")]
    #[case::steps_up("/home/u/build/../src/./x.c", "/home/u/src/x.c")]
    #[case::starts_above("../src/x.c", "../src/x.c")]
    fn names_come_from_the_image_alone(#[case] file: &str, #[case] expected: &str) {
        let build_folders = ["a/wire".to_owned(), "a/law".to_owned()].into();
        assert_eq!(Symbols { build_folders, ..Symbols::read(&[]) }.source_name(file), expected);
    }

    #[test]
    fn locates_name_and_line_of_a_function() {
        let symbols = own_symbols();
        assert!(known_function() > 0);
        let is_known = |function: &&Function| function.name.ends_with("tests::known_function");
        let known = symbols.functions.iter().find(is_known).unwrap();
        let place = symbols.locate(known.address as u32);
        assert!(place.symbol.as_ref().unwrap().ends_with("tests::known_function"), "{place}");
        assert!(place.line.as_ref().unwrap().contains("symbols.rs:"), "{place}");
        assert_eq!(symbols.locate((known.end - 1) as u32).symbol, place.symbol);
        assert_ne!(symbols.locate(known.end as u32).symbol, place.symbol);
    }

    #[test]
    fn ends_a_function_without_a_size_at_the_next() {
        let function = |(address, end)| Function { address, end, name: String::new() };
        let mut functions: Vec<_> = [(16, 16), (16, 24), (32, 32), (48, 48)].into_iter().map(function).collect();
        fill_missing_ends(&mut functions);
        assert_eq!(functions.iter().map(|function| function.end).collect::<Vec<_>>(), [32, 24, 48, 50]);
    }

    #[test]
    fn locates_other_addresses_without_a_name() {
        assert_eq!(own_symbols().locate(1).to_string(), "0x00000001");
        assert_eq!(Symbols::read(b"no ELF").locate(0x0800_0200).to_string(), "0x08000200");
    }
}
