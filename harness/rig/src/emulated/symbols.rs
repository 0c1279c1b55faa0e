//! From an address to a function and a line of the image. Read when something went wrong, not before.

use super::fault::Place;
use addr2line::Context;
use gimli::{EndianArcSlice, RunTimeEndian};
use object::{Object, ObjectSection, ObjectSymbol, SymbolKind};
use std::sync::Arc;

type Lines = Context<EndianArcSlice<RunTimeEndian>>;

struct Function {
    address: u64,
    end: u64,
    name: String,
}

/// The names of an image.
pub(super) struct Symbols {
    functions: Vec<Function>,
    others: Vec<(String, u64)>,
    lines: Option<Lines>,
}

impl Symbols {
    /// What there is to read; an image without names gives addresses alone.
    pub(super) fn read(elf: &[u8]) -> Self {
        let Ok(file) = object::File::parse(elf) else {
            return Self { functions: Vec::new(), others: Vec::new(), lines: None };
        };
        let named = || file.symbols().filter_map(|symbol| Some((symbol.name().ok()?.to_owned(), symbol)));
        let mut functions: Vec<_> = named()
            .filter(|(_, symbol)| symbol.kind() == SymbolKind::Text)
            .map(|(name, symbol)| {
                let address = symbol.address() & !1;
                Function {
                    address,
                    end: address + symbol.size().max(2),
                    name: format!("{:#}", rustc_demangle::demangle(&name)),
                }
            })
            .collect();
        functions.sort_by(|a, b| (a.address, a.end, &a.name).cmp(&(b.address, b.end, &b.name)));
        let others = named().map(|(name, symbol)| (name, symbol.address())).collect();
        let section = |id: gimli::SectionId| -> Result<_, gimli::Error> {
            let data = file
                .section_by_name(id.name())
                .and_then(|section| section.uncompressed_data().ok())
                .unwrap_or_default();
            Ok(EndianArcSlice::new(Arc::from(&*data), RunTimeEndian::Little))
        };
        let lines = gimli::Dwarf::load(section).ok().and_then(|dwarf| Context::from_dwarf(dwarf).ok());
        Self { functions, others, lines }
    }

    /// Address of the symbol that the linker knows by this name.
    pub(super) fn address(&self, name: &str) -> Option<u64> {
        self.others.iter().find(|(other, _)| other == name).map(|&(_, address)| address)
    }

    /// Where panics go.
    pub(super) fn panic_handler(&self) -> Option<u64> {
        self.functions
            .iter()
            .find(|function| function.name.ends_with("rust_begin_unwind"))
            .map(|function| function.address)
    }

    /// True where the image has code at `address`.
    pub(super) fn is_code(&self, address: u64) -> bool {
        self.function(address).is_some()
    }

    fn function(&self, address: u64) -> Option<&Function> {
        let until = self.functions.partition_point(|function| function.address <= address);
        self.functions.get(..until)?.iter().rev().take(8).find(|function| address < function.end)
    }

    /// What stands at `address`: the function that was called, then what the compiler put into it, innermost last.
    pub(super) fn place(&self, address: u32) -> Place {
        let at = u64::from(address);
        let mut symbol = self.function(at).map(|function| function.name.clone());
        let mut line = None;
        let mut frames = self.lines.as_ref().and_then(|lines| lines.find_frames(at).skip_all_loads().ok());
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

fn without_hash(name: &str) -> String {
    match name.rsplit_once("::h") {
        Some((front, hash)) if hash.len() == 16 && hash.bytes().all(|byte| byte.is_ascii_hexdigit()) => {
            front.to_owned()
        }
        _ => name.to_owned(),
    }
}
