//! Reads the modules of a crate and their imports with the parser `syn`.
//!
//! Code under `#[cfg(test)]` and paths inside macro calls are ignored.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use syn::visit::{self, Visit};
use syn::{Attribute, Item, ItemMod, ItemUse, Meta, UseTree};

/// Path of a module from the root of the crate, without `crate`.
type ModulePath = Vec<String>;

#[derive(Default)]
struct Module {
    defined: BTreeSet<String>,
    aliases: BTreeMap<String, ModulePath>,
    globs: Vec<ModulePath>,
    used: BTreeSet<ModulePath>,
}

pub(crate) struct SourceTree {
    modules: BTreeMap<ModulePath, Module>,
}

fn is_test_only(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| match &attribute.meta {
        Meta::List(list) if list.path.is_ident("cfg") => {
            list.tokens.to_string().split_whitespace().any(|word| word == "test")
        }
        _ => false,
    })
}

impl SourceTree {
    pub(crate) fn read(folder: &Path) -> Self {
        let mut tree = Self { modules: BTreeMap::new() };
        tree.read_file(&folder.join("src/lib.rs"), &folder.join("src"), &[]);
        tree
    }

    fn read_file(&mut self, file: &Path, children: &Path, path: &[String]) {
        let source = fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let source = syn::parse_file(&source).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        self.read_items(&source.items, children, path);
    }

    fn read_items(&mut self, items: &[Item], folder: &Path, path: &[String]) {
        let children: BTreeSet<String> = items
            .iter()
            .filter_map(|item| match item {
                Item::Mod(module) => Some(module.ident.to_string()),
                _ => None,
            })
            .collect();
        let mut reader = ModuleReader { path, children: &children, module: Module::default() };
        for item in items {
            reader.define(item);
            reader.visit_item(item);
        }
        self.modules.insert(path.to_vec(), reader.module);
        for item in items {
            let Item::Mod(ItemMod { ident, content, attrs, .. }) = item else { continue };
            if is_test_only(attrs) {
                continue;
            }
            let mut path = path.to_vec();
            path.push(ident.to_string());
            let below = folder.join(ident.to_string());
            if let Some((_, items)) = content {
                self.read_items(items, &below, &path);
            } else {
                let candidates: [PathBuf; 2] = [below.with_extension("rs"), below.join("mod.rs")];
                let file = candidates.iter().find(|file| file.exists()).unwrap_or(&candidates[0]);
                self.read_file(file, &below, &path);
            }
        }
    }

    /// Returns the module that defines `path`. Follows re-exports; `None` outside the crate.
    fn defining_module(&self, path: &[String], depth: u8) -> Option<ModulePath> {
        let known = (0..=path.len()).rev().find(|&count| self.modules.contains_key(&path[..count]))?;
        let (module_path, rest) = path.split_at(known);
        let module = &self.modules[module_path];
        let Some(name) = rest.first().filter(|name| !module.defined.contains(*name)) else {
            return Some(module_path.to_vec());
        };
        if depth == 0 {
            return None;
        }
        if let Some(target) = module.aliases.get(name) {
            let target: ModulePath = target.iter().chain(&rest[1..]).cloned().collect();
            return self.defining_module(&target, depth - 1);
        }
        module.globs.iter().find_map(|glob| {
            let target: ModulePath = glob.iter().chain(rest).cloned().collect();
            self.defining_module(&target, depth - 1)
        })
    }

    fn imports(&self) -> BTreeSet<(ModulePath, ModulePath)> {
        let from_module = |(from, module): (&ModulePath, &Module)| -> Vec<_> {
            let targets = module.used.iter().filter_map(|path| self.defining_module(path, 8));
            targets.filter(|to| to != from).map(|to| (from.clone(), to)).collect()
        };
        self.modules.iter().flat_map(from_module).collect()
    }

    pub(crate) fn imports_of_ancestors(&self) -> Vec<String> {
        let imports = self.imports().into_iter();
        let upward = imports.filter(|(from, to)| from.len() > to.len() && from.starts_with(to));
        upward.map(|(from, to)| format!("{} imports from its parent {}", name(&from), name(&to))).collect()
    }

    /// Returns import cycles between the children of a module. A child includes its submodules.
    pub(crate) fn cycles_between_siblings(&self) -> Vec<String> {
        let imports = self.imports();
        let mut cycles = Vec::new();
        for parent in self.modules.keys() {
            let mut edges: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
            for (from, to) in &imports {
                let child = |path: &ModulePath| path.starts_with(parent) && path.len() > parent.len();
                if child(from) && child(to) && from[parent.len()] != to[parent.len()] {
                    edges.entry(&from[parent.len()]).or_default().insert(&to[parent.len()]);
                }
            }
            let cycle_of = |start: &str| -> BTreeSet<&str> {
                let reached = reachable(&edges, start);
                reached.into_iter().filter(|&other| reachable(&edges, other).contains(start)).collect()
            };
            let found: BTreeSet<_> =
                edges.keys().map(|start| cycle_of(start)).filter(|cycle| cycle.len() > 1).collect();
            cycles.extend(found.into_iter().map(|cycle| {
                let modules = cycle.iter().map(|child| {
                    let mut path = parent.clone();
                    path.push((*child).to_owned());
                    name(&path)
                });
                format!("cycle between {}", modules.collect::<Vec<_>>().join(", "))
            }));
        }
        cycles
    }
}

fn name(path: &[String]) -> String {
    if path.is_empty() { "lib.rs".to_owned() } else { path.join("::") }
}

fn reachable<'a>(edges: &BTreeMap<&'a str, BTreeSet<&'a str>>, start: &str) -> BTreeSet<&'a str> {
    let mut reached = BTreeSet::new();
    let mut open: Vec<&str> = edges.get(start).into_iter().flatten().copied().collect();
    while let Some(next) = open.pop() {
        if reached.insert(next) {
            open.extend(edges.get(next).into_iter().flatten());
        }
    }
    reached
}

struct ModuleReader<'a> {
    path: &'a [String],
    children: &'a BTreeSet<String>,
    module: Module,
}

impl ModuleReader<'_> {
    fn define(&mut self, item: &Item) {
        let name = match item {
            Item::Const(item) => &item.ident,
            Item::Enum(item) => &item.ident,
            Item::Fn(item) => &item.sig.ident,
            Item::Static(item) => &item.ident,
            Item::Struct(item) => &item.ident,
            Item::Trait(item) => &item.ident,
            Item::Type(item) => &item.ident,
            Item::Union(item) => &item.ident,
            Item::Macro(item) => match &item.ident {
                Some(name) => name,
                None => return,
            },
            _ => return,
        };
        self.module.defined.insert(name.to_string());
    }

    /// Returns `None` if the path belongs to another crate or to a local name.
    fn path_from_root(&self, segments: &[String]) -> Option<ModulePath> {
        let first = segments.first()?;
        match first.as_str() {
            "crate" => Some(segments[1..].to_vec()),
            "self" => Some(self.path.iter().chain(&segments[1..]).cloned().collect()),
            "super" => {
                let ups = segments.iter().take_while(|segment| *segment == "super").count();
                let parent = self.path.get(..self.path.len().checked_sub(ups)?)?;
                Some(parent.iter().chain(&segments[ups..]).cloned().collect())
            }
            _ if self.children.contains(first) => Some(self.path.iter().chain(segments).cloned().collect()),
            _ => None,
        }
    }

    fn import(&mut self, tree: &UseTree, mut before: ModulePath) {
        match tree {
            UseTree::Path(part) => {
                before.push(part.ident.to_string());
                self.import(&part.tree, before);
            }
            UseTree::Group(group) => group.items.iter().for_each(|tree| self.import(tree, before.clone())),
            UseTree::Glob(_) => {
                if let Some(path) = self.path_from_root(&before) {
                    self.module.used.insert(path.clone());
                    self.module.globs.push(path);
                }
            }
            UseTree::Name(name) => self.import_as(before, &name.ident.to_string(), &name.ident.to_string()),
            UseTree::Rename(name) => self.import_as(before, &name.ident.to_string(), &name.rename.to_string()),
        }
    }

    fn import_as(&mut self, mut before: ModulePath, name: &str, alias: &str) {
        if name != "self" {
            before.push(name.to_owned());
        }
        let alias = if alias == "self" { before.last().cloned().unwrap_or_default() } else { alias.to_owned() };
        if let Some(path) = self.path_from_root(&before) {
            self.module.used.insert(path.clone());
            self.module.aliases.insert(alias, path);
        }
    }
}

impl<'ast> Visit<'ast> for ModuleReader<'_> {
    fn visit_item(&mut self, item: &'ast Item) {
        let attributes: &[Attribute] = match item {
            Item::Const(item) => &item.attrs,
            Item::Enum(item) => &item.attrs,
            Item::Fn(item) => &item.attrs,
            Item::Impl(item) => &item.attrs,
            Item::Static(item) => &item.attrs,
            Item::Struct(item) => &item.attrs,
            Item::Trait(item) => &item.attrs,
            Item::Use(item) => &item.attrs,
            Item::Mod(_) => return,
            _ => &[],
        };
        if !is_test_only(attributes) {
            visit::visit_item(self, item);
        }
    }

    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        self.import(&item.tree, Vec::new());
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let segments: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        if segments.len() > 1
            && let Some(path) = self.path_from_root(&segments)
        {
            self.module.used.insert(path);
        }
        visit::visit_path(self, path);
    }
}
