//! What comes with the program in a package: completions and man pages, made from the command line itself.

use super::{Cli, run::Verdict, stdout::Stdout};
use anyhow::Context;
use clap::{Args, CommandFactory};
use clap_complete::Shell;
use std::{fs, io::Write, path::PathBuf};

/// `relief completions`.
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// The shell
    pub shell: Shell,
}

/// `relief man`.
#[derive(Debug, Args)]
pub struct ManArgs {
    /// Folder for the pages
    pub dir: PathBuf,
}

/// Prints the completions of a shell.
pub fn completions(args: &CompletionsArgs) -> anyhow::Result<Verdict> {
    let mut text = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::command(), "relief", &mut text);
    Stdout.write_all(&text)?;
    Ok(Verdict::Done)
}

/// Writes a page for the program and one for each sub-command.
pub fn man(args: &ManArgs) -> anyhow::Result<Verdict> {
    let in_folder = || format!("cannot write man pages into {}", args.dir.display());
    fs::create_dir_all(&args.dir).with_context(in_folder)?;
    clap_mangen::generate_to(Cli::command(), &args.dir).with_context(in_folder)?;
    Ok(Verdict::Done)
}
