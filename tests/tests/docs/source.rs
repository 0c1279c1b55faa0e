//! Describes attributes and types of Rust source in words.

use syn::{Attribute, Expr, GenericArgument, Lit, Meta, PathArguments, Type};

pub(crate) fn doc_comment(attributes: &[Attribute]) -> String {
    let lines = attributes.iter().filter_map(|attribute| match &attribute.meta {
        Meta::NameValue(pair) if pair.path.is_ident("doc") => match &pair.value {
            Expr::Lit(literal) => match &literal.lit {
                Lit::Str(text) => Some(text.value().trim().to_owned()),
                _ => None,
            },
            _ => None,
        },
        _ => None,
    });
    lines.collect::<Vec<_>>().join(" ").trim().to_owned()
}

pub(crate) fn has_default(attributes: &[Attribute]) -> bool {
    let mut found = false;
    for attribute in attributes.iter().filter(|attribute| attribute.path().is_ident("serde")) {
        let _ = attribute.parse_nested_meta(|meta| {
            found |= meta.path.is_ident("default");
            if meta.input.peek(syn::Token![=]) {
                meta.value()?.parse::<Expr>()?;
            }
            Ok(())
        });
    }
    found
}

#[derive(Default)]
pub(crate) struct KeyType {
    pub(crate) name: String,
    pub(crate) optional: bool,
    pub(crate) list: bool,
    pair: bool,
}

impl KeyType {
    pub(crate) fn describe(&self) -> String {
        let word = match &*self.name {
            "f64" => "number",
            "i64" | "u32" => "whole number",
            "String" | "PathBuf" => "text",
            "bool" => "true or false",
            "RawProfile" => "number or profile",
            "RawWindow" => "number or [number, number]",
            "AnswerKind" => "`confirm` or `text`",
            "QuestionTime" => "`before` or `after`",
            _ => "value",
        };
        let word = if self.pair { format!("[{word}, {word}]") } else { word.to_owned() };
        if self.list { format!("list of {word}") } else { word }
    }
}

pub(crate) fn describe_type(of: &Type) -> KeyType {
    match of {
        Type::Array(array) => KeyType { pair: true, ..describe_type(&array.elem) },
        Type::Path(path) => {
            let last = path.path.segments.last().unwrap();
            let inner = match &last.arguments {
                PathArguments::AngleBracketed(arguments) => match arguments.args.first() {
                    Some(GenericArgument::Type(inner)) => Some(describe_type(inner)),
                    _ => None,
                },
                _ => None,
            };
            match (inner, &*last.ident.to_string()) {
                (Some(inner), "Option") => KeyType { optional: true, ..inner },
                (Some(inner), "Vec") => KeyType { list: true, ..inner },
                (_, name) => KeyType { name: name.to_owned(), ..KeyType::default() },
            }
        }
        _ => panic!("a key has an unknown type"),
    }
}
