//! `platebench generate`: prints or writes files that the program derives from its own definitions.

mod completions;
mod man;
mod schema;

pub(crate) use schema::SchemaKind;

use crate::failure::CommandResult;
use clap::{Args, Command, Subcommand};

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
    Schema(schema::SchemaArgs),
    /// Print shell completions
    Completions(completions::CompletionsArgs),
    /// Print or write manual pages
    Man(man::ManArgs),
}

/// `definition` returns the command line that completions and manual pages describe.
pub(crate) fn generate(arguments: &GenerateArgs, definition: impl FnOnce() -> Command) -> CommandResult {
    match &arguments.action {
        GenerateAction::Schema(arguments) => schema::schema(arguments),
        GenerateAction::Completions(arguments) => Ok(completions::completions(arguments, definition())),
        GenerateAction::Man(arguments) => man::man(arguments, definition()),
    }
}
