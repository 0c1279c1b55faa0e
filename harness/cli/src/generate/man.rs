//! `platebench generate man`: prints or writes manual pages.

use crate::exit::Exit;
use crate::failure::{CommandResult, OrInvalid};
use crate::stdio;
use clap::{Args, Command};
use std::fs;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench generate man | man -l -
  platebench generate man --out ~/.local/share/man/man1    platebench.1 and a page for each command

Exit codes: 0 written, 2 a file cannot be written")]
pub(crate) struct ManArgs {
    /// Write the pages of all commands to this folder instead of printing the first
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(crate) fn man(arguments: &ManArgs, definition: Command) -> CommandResult {
    if let Some(folder) = &arguments.out {
        fs::create_dir_all(folder).or_invalid_at(folder)?;
        clap_mangen::generate_to(definition, folder).or_invalid_at(folder)?;
    } else {
        let mut page = Vec::new();
        clap_mangen::Man::new(definition).render(&mut page).or_invalid()?;
        stdio::show(&String::from_utf8_lossy(&page));
    }
    Ok(Exit::Passed)
}
