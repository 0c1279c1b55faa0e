//! `platebench man`: manual pages.

use crate::config::{self, Config};
use crate::exit::Exit;
use crate::output;
use clap::Args;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// `platebench man`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench man | man -l -
  platebench man --out ~/.local/share/man/man1    platebench.1 and a page for each command

Exit codes: 0 written, 2 a file cannot be written")]
pub(crate) struct Man {
    /// Write the pages of all commands into this folder instead of showing the first
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Shows or writes manual pages.
pub(crate) fn man(arguments: &Man) -> Exit {
    let command = config::command(&Config::default());
    let done = match &arguments.out {
        Some(folder) => fs::create_dir_all(folder)
            .and_then(|()| clap_mangen::generate_to(command, folder))
            .map_err(|error| (folder.as_path(), error)),
        None => shown(command).map_err(|error| (Path::new("platebench.1"), error)),
    };
    match done {
        Ok(()) => Exit::Passed,
        Err((path, error)) => {
            output::error(&format!("{}: {error}", path.display()));
            Exit::Invalid
        }
    }
}

fn shown(command: clap::Command) -> io::Result<()> {
    let mut page = Vec::new();
    clap_mangen::Man::new(command).render(&mut page)?;
    output::show(&String::from_utf8_lossy(&page));
    Ok(())
}
