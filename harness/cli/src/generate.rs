//! `platebench generate`: prints or writes files that the program derives from its own definitions:
//! JSON Schemas of input files (for editors) and of results (for programs), shell completions and
//! manual pages.

use crate::config::RawConfig;
use crate::exit::{CommandResult, Exit, OrInvalid};
use crate::identify::IdentifyOutput;
use crate::stdio;
use crate::tune::TuneOutput;
use clap::{Args, Command, Subcommand, ValueEnum};
use clap_complete::Shell;
use platebench_design::margins::result::MarginReport;
#[cfg(feature = "export")]
use platebench_experiments::campaign::comparison::CampaignComparison;
#[cfg(feature = "export")]
use platebench_experiments::campaign::{RawCampaign, summary::CampaignResult};
use platebench_experiments::explore::{ExploreReport, RawEnvelope};
use platebench_experiments::trust::TrustReport;
use platebench_lab::acceptance::SessionRecord;
use platebench_lab::acceptance::plan::plan_schema;
use platebench_lab::boards::{BoardStatus, RawInventory, SoakRecord};
use platebench_model::record::{Event, RunRecord};
use platebench_model::scenario::schema;
use platebench_model::trace::OutputFolder;
use platebench_report::comparison::ScenarioComparison;
use platebench_report::scenario_list::ScenarioList;
use platebench_rig::RIGS;
use platebench_verdict::replay::ReplayResult;
use serde_json::json;
use std::fs::{self, File};
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench generate schema > scenario.json
  platebench generate completions bash > ~/.local/share/bash-completion/completions/platebench
  platebench generate man --out ~/.local/share/man/man1")]
pub(crate) struct GenerateArgs {
    #[command(subcommand)]
    action: GenerateAction,
}

#[derive(Debug, Subcommand)]
enum GenerateAction {
    /// Print JSON Schemas: of input files for editors, of results for programs
    Schema(SchemaArgs),
    /// Print shell completions
    Completions(CompletionsArgs),
    /// Print or write manual pages
    Man(ManArgs),
}

/// `definition` returns the command line that completions and manual pages describe.
pub(crate) fn generate(arguments: &GenerateArgs, definition: impl FnOnce() -> Command) -> CommandResult {
    match &arguments.action {
        GenerateAction::Schema(arguments) => write_schemas(arguments),
        GenerateAction::Completions(arguments) => Ok(show_completions(arguments, definition())),
        GenerateAction::Man(arguments) => write_manual(arguments, definition()),
    }
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench generate schema > scenario.json        `#:schema scenario.json` as the first line of a scenario enables completion
  platebench generate schema config > config.json
  platebench generate schema run > run.json         the record of a run, run.json
  platebench generate schema --out scenarios/schema all files

Exit codes: 0 written, 2 a file cannot be written")]
struct SchemaArgs {
    /// Kind of file
    #[arg(value_enum, default_value_t = SchemaKind::Scenario)]
    kind: SchemaKind,
    /// Write the schemas of all kinds to this folder, as scenario.json and so on
    #[arg(long, value_name = "FOLDER", conflicts_with = "kind")]
    out: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum SchemaKind {
    /// Scenario files
    Scenario,
    /// Plate files
    Plate,
    /// Plans of acceptance sessions
    Plan,
    /// Operating envelopes
    Envelope,
    /// Campaigns
    #[cfg(feature = "export")]
    Campaign,
    /// boards.toml
    Boards,
    /// platebench.toml
    Config,
    /// run.json of a run folder
    Run,
    /// Lines of run --format json
    Events,
    /// run --list --format json
    List,
    /// compare --format json
    Comparison,
    /// replay --format json
    Replay,
    /// identify --format json
    Identification,
    /// tune --format json
    Tuning,
    /// stability --rig --format json
    Margins,
    /// summary.json of a campaign
    #[cfg(feature = "export")]
    Summary,
    /// comparison.json of two campaigns
    #[cfg(feature = "export")]
    CampaignComparison,
    /// explore.json
    Exploration,
    /// suite trust --format json
    Trust,
    /// session.json of an acceptance session
    Session,
    /// soak.json
    Soak,
    /// board list --format json
    BoardList,
}

impl SchemaKind {
    /// Adds the identifier `$id`, which validators and other schemas need to refer to this schema.
    fn schema(self) -> schemars::Schema {
        let mut named = serde_json::Map::new();
        let schema = self.content().to_value();
        named.insert("$schema".to_owned(), schema["$schema"].clone());
        named.insert("$id".to_owned(), format!("urn:platebench:schema:{}", self.name()).into());
        named.extend(schema.as_object().cloned().unwrap_or_default());
        named.into()
    }

    fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    fn file_name(self) -> String {
        format!("{}.json", self.name())
    }

    fn content(self) -> schemars::Schema {
        match self {
            Self::Scenario => {
                let mut schema = schema::scenario_schema();
                let laws: Vec<_> = platebench_engine::law_names().collect();
                if let Some(law) = schema.pointer_mut("/$defs/RawController/properties/law") {
                    let laws = json!({ "type": "string", "enum": laws });
                    law["anyOf"] = json!([laws, { "$ref": "#/$defs/Placeholder" }]);
                }
                schema
            }
            Self::Plate => schema::plate_schema(),
            Self::Plan => plan_schema(),
            Self::Envelope => schema::schema_of::<RawEnvelope>("Operating envelope"),
            #[cfg(feature = "export")]
            Self::Campaign => schema::schema_of::<RawCampaign>("Campaign"),
            Self::Boards => schema::schema_of::<RawInventory>("boards.toml"),
            Self::Config => schema::schema_of::<RawConfig>("platebench.toml"),
            Self::Run => schema::schema_of_json::<RunRecord>("Record of a run: run.json"),
            Self::Events => schema::schema_of_json::<Event>("Event of a run: a line of run --format json"),
            Self::List => schema::schema_of_json::<ScenarioList<'_>>("Scenarios: run --list --format json"),
            Self::Comparison => schema::schema_of_json::<Vec<ScenarioComparison>>("Comparison: compare --format json"),
            Self::Replay => schema::schema_of_json::<ReplayResult>("Replay of a recording: replay --format json"),
            Self::Identification => {
                schema::schema_of_json::<IdentifyOutput<'_>>("Identified plate: identify --format json")
            }
            Self::Tuning => schema::schema_of_json::<TuneOutput<'_>>("Tuned gains: tune --format json"),
            Self::Margins => schema::schema_of_json::<MarginReport>("Measured margins: stability --rig --format json"),
            #[cfg(feature = "export")]
            Self::Summary => schema::schema_of_json::<CampaignResult<'_>>("Result of a campaign: summary.json"),
            #[cfg(feature = "export")]
            Self::CampaignComparison => schema::schema_of_json::<CampaignComparison>(
                "Paired differences of controllers: comparison.json of a campaign",
            ),
            Self::Exploration => schema::schema_of_json::<ExploreReport>("Result of an exploration: explore.json"),
            Self::Trust => schema::schema_of_json::<TrustReport>("Kill rate of a suite: suite trust --format json"),
            Self::Session => schema::schema_of_json::<SessionRecord>("Acceptance session: session.json"),
            Self::Soak => schema::schema_of_json::<SoakRecord>("Soak of a board: soak.json"),
            Self::BoardList => schema::schema_of_json::<Vec<BoardStatus>>("Boards: board list --format json"),
        }
    }

    pub(crate) fn to_text(self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(&self.schema()).map(|text| format!("{text}\n"))
    }
}

fn write_schemas(arguments: &SchemaArgs) -> CommandResult {
    let Some(folder) = &arguments.out else {
        stdio::show(&arguments.kind.to_text().or_invalid()?);
        return Ok(Exit::Passed);
    };
    let folder = OutputFolder::create(folder).or_invalid()?;
    for kind in SchemaKind::value_variants() {
        folder.write(kind.file_name(), kind.to_text().or_invalid()?).or_invalid()?;
    }
    Ok(Exit::Passed)
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench generate completions bash > ~/.local/share/bash-completion/completions/platebench
  platebench generate completions zsh > ~/.zfunc/_platebench           with ~/.zfunc in $fpath before compinit
  platebench generate completions fish > ~/.config/fish/completions/platebench.fish")]
struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

const BASH_NAMES: &str = include_str!("names.bash");

fn bash_names() -> String {
    let rigs: Vec<_> = RIGS.iter().map(|rig| rig.name).collect();
    BASH_NAMES.replace("@RIGS@", &rigs.join("\\n"))
}

fn show_completions(arguments: &CompletionsArgs, mut definition: Command) -> Exit {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut definition, "platebench", &mut script);
    if arguments.shell == Shell::Bash {
        script.extend_from_slice(bash_names().as_bytes());
    }
    stdio::show(&String::from_utf8_lossy(&script));
    Exit::Passed
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench generate man | man -l -
  platebench generate man --out ~/.local/share/man/man1    platebench.1 and a page for each command

Exit codes: 0 written, 2 a file cannot be written")]
struct ManArgs {
    /// Write the pages of all commands to this folder instead of printing the first
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

fn write_manual(arguments: &ManArgs, definition: Command) -> CommandResult {
    if let Some(folder) = &arguments.out {
        let output = OutputFolder::create(folder).or_invalid()?;
        // The library writes through links, so it gets an empty folder.
        let pages = tempfile::tempdir().or_invalid()?;
        clap_mangen::generate_to(definition, &pages).or_invalid_at(folder)?;
        for page in fs::read_dir(&pages).or_invalid()? {
            let page = page.or_invalid()?;
            output.copy(&mut File::open(page.path()).or_invalid()?, page.file_name()).or_invalid()?;
        }
    } else {
        let mut page = Vec::new();
        clap_mangen::Man::new(definition).render(&mut page).or_invalid()?;
        stdio::show(&String::from_utf8_lossy(&page));
    }
    Ok(Exit::Passed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../scenarios");

    #[test]
    fn the_schemas_in_the_repository_are_current() {
        for kind in SchemaKind::value_variants() {
            let committed =
                fs::read_to_string(Path::new(FOLDER).join("schema").join(kind.file_name())).unwrap_or_default();
            assert!(
                committed == kind.to_text().unwrap(),
                "{} has drifted: platebench generate schema --out scenarios/schema",
                kind.file_name()
            );
        }
    }

    #[test]
    fn bash_completes_every_rig() {
        assert!(bash_names().contains("--rig) names=$'hosted\\nemulated\\n"), "{}", bash_names());
        assert!(RIGS.iter().all(|rig| bash_names().contains(rig.name)));
    }

    #[test]
    fn the_schema_lists_every_law() {
        let schema = SchemaKind::Scenario.schema();
        let laws = &schema.as_value()["$defs"]["RawController"]["properties"]["law"]["anyOf"][0]["enum"];
        assert_eq!(laws.as_array().unwrap().len(), platebench_engine::law_names().count());
    }
}
