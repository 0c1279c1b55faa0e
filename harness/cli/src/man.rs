//! `platebench man`: prints or writes manual pages.

use crate::exit::Exit;
use crate::stdio;
use clap::{Args, Command};
use std::fs;
use std::io;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench man | man -l -
  platebench man --out ~/.local/share/man/man1    platebench.1 and a page for each command

Exit codes: 0 written, 2 a file cannot be written")]
pub(crate) struct ManArgs {
    /// Write the pages of all commands to this folder instead of printing the first
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

pub(crate) fn man(arguments: &ManArgs, definition: Command) -> Exit {
    let written = match &arguments.out {
        Some(folder) => fs::create_dir_all(folder)
            .and_then(|()| clap_mangen::generate_to(definition, folder))
            .map_err(|error| format!("{}: {error}", folder.display())),
        None => print_manual(definition).map_err(|error| error.to_string()),
    };
    match written {
        Ok(()) => Exit::Passed,
        Err(error) => stdio::reject(&error),
    }
}

fn print_manual(definition: Command) -> io::Result<()> {
    let mut page = Vec::new();
    clap_mangen::Man::new(definition).render(&mut page)?;
    stdio::show(&String::from_utf8_lossy(&page));
    Ok(())
}
