//! `platebench generate completions`: prints shell completions.

use crate::exit::Exit;
use crate::stdio;
use clap::{Args, Command};
use clap_complete::Shell;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench generate completions bash > ~/.local/share/bash-completion/completions/platebench
  platebench generate completions zsh > ~/.zfunc/_platebench           with ~/.zfunc in $fpath before compinit
  platebench generate completions fish > ~/.config/fish/completions/platebench.fish")]
pub(crate) struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

pub(crate) fn completions(arguments: &CompletionsArgs, mut definition: Command) -> Exit {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut definition, "platebench", &mut script);
    stdio::show(&String::from_utf8_lossy(&script));
    Exit::Passed
}
