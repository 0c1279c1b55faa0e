//! `platebench schema`: JSON Schema of the files that people write, for editors.

use crate::config::RawConfig;
use crate::exit::Exit;
use crate::output;
use clap::{Args, ValueEnum};
use platebench_acceptance::plan::plan_schema;
use platebench_scenario::schema;
use platebench_wire::LawId;
use std::fs;
use std::path::PathBuf;

/// `platebench schema`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench schema > scenario.json        then `#:schema scenario.json` as the first line of a scenario lets editors complete
  platebench schema config > config.json
  platebench schema --out scenarios/schema all four files

Exit codes: 0 written, 2 a file cannot be written")]
pub(crate) struct Schema {
    /// Of which files
    #[arg(value_enum, default_value_t = Kind::Scenario)]
    kind: Kind,
    /// Write the schemas of all kinds into this folder, as scenario.json and so on
    #[arg(long, value_name = "FOLDER", conflicts_with = "kind")]
    out: Option<PathBuf>,
}

/// A kind of file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Scenario files
    Scenario,
    /// Plate files
    Plate,
    /// Plans of acceptance sessions
    Plan,
    /// platebench.toml
    Config,
}

impl Kind {
    const fn file(self) -> &'static str {
        match self {
            Self::Scenario => "scenario.json",
            Self::Plate => "plate.json",
            Self::Plan => "plan.json",
            Self::Config => "config.json",
        }
    }

    fn schema(self) -> schemars::Schema {
        match self {
            Self::Scenario => {
                let mut schema = schema::scenario();
                let laws: Vec<_> = LawId::ALL.map(LawId::name).to_vec();
                if let Some(law) = schema.pointer_mut("/$defs/RawController/properties/law") {
                    law["enum"] = laws.into();
                }
                schema
            }
            Self::Plate => schema::plate(),
            Self::Plan => plan_schema(),
            Self::Config => schema::of::<RawConfig>("platebench.toml"),
        }
    }

    fn text(self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(&self.schema()).map(|text| format!("{text}\n"))
    }
}

/// Shows or writes schemas.
pub(crate) fn schema(arguments: &Schema) -> Exit {
    let done = match &arguments.out {
        None => arguments.kind.text().map(|text| output::show(&text)).map_err(|error| error.to_string()),
        Some(folder) => {
            let made = fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()));
            made.and_then(|()| {
                Kind::value_variants().iter().try_for_each(|kind| {
                    let path = folder.join(kind.file());
                    let text = kind.text().map_err(|error| error.to_string())?;
                    fs::write(&path, text).map_err(|error| format!("{}: {error}", path.display()))
                })
            })
        }
    };
    match done {
        Ok(()) => Exit::Passed,
        Err(error) => {
            output::error(&error);
            Exit::Invalid
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../scenarios");

    /// `platebench schema --out scenarios/schema` writes them anew.
    #[test]
    fn the_schemas_in_the_repository_are_those_of_the_code() {
        for kind in Kind::value_variants() {
            let committed = fs::read_to_string(Path::new(FOLDER).join("schema").join(kind.file())).unwrap_or_default();
            assert!(
                committed == kind.text().unwrap(),
                "{} has drifted: platebench schema --out scenarios/schema",
                kind.file()
            );
        }
    }

    #[test]
    fn laws_are_those_of_the_firmware() {
        let schema = Kind::Scenario.schema();
        let laws = &schema.as_value()["$defs"]["RawController"]["properties"]["law"]["enum"];
        assert_eq!(laws.as_array().unwrap().len(), LawId::ALL.len());
    }
}
