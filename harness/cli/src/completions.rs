//! `platebench completions`: what shells complete.

use crate::config::{self, Config};
use crate::exit::Exit;
use crate::output;
use clap::Args;
use clap_complete::Shell;

/// `platebench completions`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench completions bash > ~/.local/share/bash-completion/completions/platebench
  platebench completions zsh > ~/.zfunc/_platebench           with ~/.zfunc in $fpath before compinit
  platebench completions fish > ~/.config/fish/completions/platebench.fish")]
pub(crate) struct Completions {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

/// Shows the shell's script.
pub(crate) fn completions(arguments: &Completions) -> Exit {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut config::command(&Config::default()), "platebench", &mut script);
    output::show(&String::from_utf8_lossy(&script));
    Exit::Passed
}
