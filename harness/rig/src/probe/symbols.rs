//! Names of addresses: the symbol table says the function, DWARF says file and line.

use addr2line::Context;
use addr2line::gimli::{DebugFrame, Dwarf, EndianSlice, RunTimeEndian, SectionId};
use object::{Object, ObjectSection, ObjectSymbol, SymbolKind};
use std::fmt;

pub(super) type Slice<'a> = EndianSlice<'a, RunTimeEndian>;

/// Where an address is in the source, as far as it is known.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Place {
    /// The function, demangled.
    pub function: Option<String>,
    /// File and line.
    pub line: Option<String>,
}

impl fmt::Display for Place {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.function {
            Some(function) => write!(formatter, "in {function}")?,
            None => formatter.write_str("in no known function")?,
        }
        self.line.as_ref().map_or(Ok(()), |line| write!(formatter, " ({line})"))
    }
}

/// What an ELF knows of its addresses.
pub(super) struct Symbols<'a> {
    file: object::File<'a>,
    lines: Option<Context<Slice<'a>>>,
    endian: RunTimeEndian,
}

impl<'a> Symbols<'a> {
    /// `None` where it is no ELF.
    pub(super) fn new(elf: &'a [u8]) -> Option<Self> {
        let file = object::File::parse(elf).ok()?;
        let endian = if file.is_little_endian() { RunTimeEndian::Little } else { RunTimeEndian::Big };
        let load = |id: SectionId| Ok::<_, addr2line::gimli::Error>(section(&file, id.name(), endian));
        let lines = Dwarf::load(load).and_then(Context::from_dwarf).ok();
        Some(Self { file, lines, endian })
    }

    /// The call frame information that `unwind` works with.
    pub(super) fn frames(&self) -> DebugFrame<Slice<'a>> {
        let mut frames = DebugFrame::from(section(&self.file, ".debug_frame", self.endian));
        frames.set_address_size(4);
        frames
    }

    /// Function and source line of `address`.
    pub(super) fn place(&self, address: u64) -> Place {
        let function = self.function(address);
        // What the linker left out stays in the line table at address zero: a line without a function is none.
        let lines = self.lines.as_ref().filter(|_| function.is_some());
        let location = lines.and_then(|lines| lines.find_location(address).ok().flatten());
        let line = location.and_then(|location| {
            let file = location.file?;
            Some(location.line.map_or_else(|| file.to_owned(), |line| format!("{file}:{line}")))
        });
        Place { function, line }
    }

    fn function(&self, address: u64) -> Option<String> {
        // Symbols of Thumb functions carry a one in bit 0, code addresses do not.
        let thumb = matches!(self.file.architecture(), object::Architecture::Arm);
        let start = |symbol: &object::Symbol<'_, '_>| if thumb { symbol.address() & !1 } else { symbol.address() };
        let named = self.file.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.is_definition());
        let before = named.filter(|symbol| start(symbol) <= address);
        let nearest = before.max_by_key(start)?;
        // Functions written in assembler may have no size; one that has must contain the address.
        let inside = nearest.size() == 0 || address < start(&nearest) + nearest.size();
        inside.then(|| nearest.name().ok().map(|name| format!("{:#}", rustc_demangle::demangle(name)))).flatten()
    }
}

fn section<'a>(file: &object::File<'a>, name: &str, endian: RunTimeEndian) -> Slice<'a> {
    let data = file.section_by_name(name).and_then(|section| section.data().ok());
    EndianSlice::new(data.unwrap_or_default(), endian)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[inline(never)]
    fn a_function_that_symbols_know() -> u32 {
        std::hint::black_box(std::process::id())
    }

    #[test]
    fn a_function_has_its_name_and_its_line() {
        let elf = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        let symbols = Symbols::new(&elf).unwrap();
        assert!(a_function_that_symbols_know() > 0);
        let is_it = |symbol: &object::Symbol<'_, '_>| {
            symbol.name().is_ok_and(|name| name.contains("a_function_that_symbols_know"))
        };
        let known = symbols.file.symbols().find(is_it).unwrap();
        let place = symbols.place(known.address());
        assert!(place.function.as_ref().unwrap().ends_with("tests::a_function_that_symbols_know"), "{place}");
        assert!(place.line.as_ref().unwrap().contains("symbols.rs:"), "{place}");
        assert_eq!(symbols.place(1).to_string(), "in no known function");
    }
}
