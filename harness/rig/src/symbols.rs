//! From an address to a function and a line of an image, for whoever tells what its processor did. Read when something went wrong, not before.

use addr2line::Context;
use gimli::{Dwarf, EndianArcSlice, RunTimeEndian, SectionId};
use object::{Object, ObjectSection, ObjectSymbol, SymbolKind};
use std::fmt;
use std::sync::Arc;

pub(crate) type Slice = EndianArcSlice<RunTimeEndian>;

/// Compilers give several names to code that they found to be the same.
const MOST_NAMES_AT_ONCE: usize = 8;

/// A place in an image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Address of the instruction.
    pub address: u32,
    /// Function, where the image names one there.
    pub symbol: Option<String>,
    /// Source file and line, where the image has them.
    pub line: Option<String>,
}

impl fmt::Display for Place {
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

struct Function {
    address: u64,
    end: u64,
    name: String,
}

/// The names of an image.
pub(crate) struct Symbols {
    functions: Vec<Function>,
    all: Vec<(String, u64)>,
    lines: Option<Context<Slice>>,
    #[cfg(feature = "probe")]
    frames: Slice,
}

impl Symbols {
    /// What there is to read; an image without names gives addresses alone.
    pub(crate) fn read(elf: &[u8]) -> Self {
        let file = object::File::parse(elf).ok();
        let file = file.as_ref();
        let named: Vec<_> = match file {
            Some(file) => file.symbols().filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol))).collect(),
            None => Vec::new(),
        };
        let load = |id| Ok::<_, gimli::Error>(section(file, id));
        Self {
            functions: functions(&named),
            all: named.into_iter().map(|(name, symbol)| (name, symbol.address())).collect(),
            lines: Dwarf::load(load).and_then(Context::from_dwarf).ok(),
            #[cfg(feature = "probe")]
            frames: section(file, SectionId::DebugFrame),
        }
    }

    /// Address of the symbol that the linker knows by this name.
    pub(crate) fn address(&self, name: &str) -> Option<u64> {
        self.all.iter().find(|(other, _)| other == name).map(|&(_, address)| address)
    }

    /// Where panics go.
    pub(crate) fn panic_handler(&self) -> Option<u64> {
        self.functions
            .iter()
            .find(|function| function.name.ends_with("rust_begin_unwind"))
            .map(|function| function.address)
    }

    /// The call frame information of a 32-bit image.
    #[cfg(feature = "probe")]
    pub(crate) fn frames(&self) -> gimli::DebugFrame<Slice> {
        let mut frames = gimli::DebugFrame::from(self.frames.clone());
        frames.set_address_size(4);
        frames
    }

    /// True where the image has code at `address`.
    pub(crate) fn is_code(&self, address: u64) -> bool {
        self.function(address).is_some()
    }

    fn function(&self, address: u64) -> Option<&Function> {
        let until = self.functions.partition_point(|function| function.address <= address);
        let before = self.functions.get(..until)?.iter().rev();
        before.take(MOST_NAMES_AT_ONCE).find(|function| address < function.end)
    }

    /// What stands at `address`: the function that was called, then what the compiler put into it, innermost last.
    pub(crate) fn place(&self, address: u32) -> Place {
        let at = u64::from(address);
        let mut symbol = self.function(at).map(|function| function.name.clone());
        let mut line = None;
        // What the linker left out stays in the line table at address zero: where functions are known, a line outside of all of them is none.
        let lines = self.lines.as_ref().filter(|_| symbol.is_some() || self.functions.is_empty());
        let mut frames = lines.and_then(|lines| lines.find_frames(at).skip_all_loads().ok());
        let mut inlined = Vec::new();
        while let Some(Ok(Some(frame))) = frames.as_mut().map(addr2line::FrameIter::next) {
            // The innermost line that is not the compiler's own library: that is where the reader can do something.
            if let Some(location) = frame.location
                && line.as_ref().is_none_or(|(own, _)| !own)
                && let (Some(file), Some(number)) = (location.file, location.line)
            {
                let own = !file.contains("/library/");
                if own || line.is_none() {
                    line = Some((own, format!("{file}:{number}")));
                }
            }
            if let Some(function) = &frame.function
                && let Ok(name) = function.demangle()
            {
                inlined.push(without_hash(&name));
            }
        }
        // The outermost frame is the function itself.
        inlined.pop();
        if let (Some(symbol), Some(innermost)) = (&mut symbol, inlined.iter().find(|name| !name.starts_with("core::")))
        {
            *symbol = format!("{innermost} inlined into {symbol}");
        }
        Place { address, symbol, line: line.map(|(_, line)| line) }
    }
}

/// Functions by address. One without a size, as assemblers leave it, reaches up to the next one.
fn functions(named: &[(String, object::Symbol<'_, '_>)]) -> Vec<Function> {
    let defined = named.iter().filter(|(_, symbol)| symbol.kind() == SymbolKind::Text && symbol.is_definition());
    let function = |(name, symbol): &(String, object::Symbol<'_, '_>)| {
        // Symbols of Thumb functions carry a one in bit 0, code addresses do not.
        let address = symbol.address() & !1;
        Function { address, end: address + symbol.size(), name: format!("{:#}", rustc_demangle::demangle(name)) }
    };
    let mut functions: Vec<_> = defined.map(function).collect();
    functions.sort_by(|a, b| (a.address, a.end, &a.name).cmp(&(b.address, b.end, &b.name)));
    reach_up(&mut functions);
    functions
}

/// Gives an end to those of `functions`, which are in order, that have none.
fn reach_up(functions: &mut [Function]) {
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

fn section(file: Option<&object::File<'_>>, id: SectionId) -> Slice {
    let data = file.and_then(|file| file.section_by_name(id.name())?.uncompressed_data().ok()).unwrap_or_default();
    EndianArcSlice::new(Arc::from(&*data), RunTimeEndian::Little)
}

fn without_hash(name: &str) -> String {
    match name.rsplit_once("::h") {
        Some((front, hash)) if hash.len() == 16 && hash.bytes().all(|byte| byte.is_ascii_hexdigit()) => {
            front.to_owned()
        }
        _ => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[inline(never)]
    fn a_function_that_symbols_know() -> u32 {
        std::hint::black_box(std::process::id())
    }

    fn of_this_program() -> Symbols {
        Symbols::read(&std::fs::read(std::env::current_exe().unwrap()).unwrap())
    }

    #[test]
    fn a_function_has_its_name_and_its_line() {
        let symbols = of_this_program();
        assert!(a_function_that_symbols_know() > 0);
        let is_it = |function: &&Function| function.name.ends_with("tests::a_function_that_symbols_know");
        let known = symbols.functions.iter().find(is_it).unwrap();
        let place = symbols.place(known.address as u32);
        assert!(place.symbol.as_ref().unwrap().ends_with("tests::a_function_that_symbols_know"), "{place}");
        assert!(place.line.as_ref().unwrap().contains("symbols.rs:"), "{place}");
        assert_eq!(symbols.place((known.end - 1) as u32).symbol, place.symbol);
        assert_ne!(symbols.place(known.end as u32).symbol, place.symbol);
    }

    #[test]
    fn a_function_without_a_size_reaches_up_to_the_next_address() {
        let function = |(address, end)| Function { address, end, name: String::new() };
        let mut functions: Vec<_> = [(16, 16), (16, 24), (32, 32), (48, 48)].into_iter().map(function).collect();
        reach_up(&mut functions);
        assert_eq!(functions.iter().map(|function| function.end).collect::<Vec<_>>(), [32, 24, 48, 50]);
    }

    #[test]
    fn what_no_function_holds_is_an_address_alone() {
        assert_eq!(of_this_program().place(1).to_string(), "0x00000001");
        assert_eq!(Symbols::read(b"no ELF").place(0x0800_0200).to_string(), "0x08000200");
    }
}
