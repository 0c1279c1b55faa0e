//! Finds the source lines of an address, with paths that exist here if possible.

use platebench_rig::Symbols;
use platebench_rig::symbols::SourceFrame;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;

/// Fewest components of a path, because a shorter path may name another file.
const MIN_COMPONENTS: usize = 3;

pub(crate) struct SourceMap<'a> {
    symbols: &'a Symbols,
    resolved: RefCell<BTreeMap<String, String>>,
}

impl<'a> SourceMap<'a> {
    pub(crate) fn new(symbols: &'a Symbols) -> Self {
        Self { symbols, resolved: RefCell::default() }
    }

    pub(crate) fn frames(&self, address: u32) -> Vec<SourceFrame> {
        let mut frames = self.symbols.frames(address);
        let mut resolved = self.resolved.borrow_mut();
        for line in frames.iter_mut().filter_map(|frame| frame.line.as_mut()) {
            if !resolved.contains_key(&line.file) {
                resolved.insert(line.file.clone(), resolve(&line.file));
            }
            if let Some(file) = resolved.get(&line.file) {
                line.file.clone_from(file);
            }
        }
        frames
    }
}

/// Removes leading folders until the file exists, because compilers may put the build folder in
/// front of another path.
fn resolve(file: &str) -> String {
    let mut rest = file;
    loop {
        if Path::new(rest).is_file() {
            return rest.to_owned();
        }
        match rest.split_once('/') {
            Some((_, shorter)) if shorter.split('/').count() >= MIN_COMPONENTS => rest = shorter,
            _ => return file.to_owned(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn removes_a_prefix_only_if_the_rest_exists() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a/b/c.rs");
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, "").unwrap();
        let path = path.display().to_string();
        assert_eq!(resolve(&format!("build/{path}")), path);
        assert_eq!(resolve("build/src/missing.rs"), "build/src/missing.rs");
    }
}
