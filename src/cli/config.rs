//! `relief config`: what is configured, by whom, and whether it makes sense.

use super::{run::Verdict, stdout::Stdout};
use clap::{Args, Subcommand};
use relief::config::{LayerPlaces, LayeredConfig, Overrides};
use serde_json::{Map, Value, json};
use std::{io::Write, path::PathBuf};

/// `relief config`.
#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Print the configuration that is in force
    Show(ShowArgs),
    /// Check a file, or all that is in force without one
    Check(CheckArgs),
}

impl ConfigCommand {
    /// Whether standard output is for one JSON object.
    pub fn prints_json(&self) -> bool {
        matches!(self, ConfigCommand::Show(args) if args.json)
    }
}

/// `relief config show`.
#[derive(Debug, Args)]
pub struct ShowArgs {
    /// Configuration; keys that it leaves out keep their values from the layers below
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Say of every key where its value comes from
    #[arg(long)]
    pub origin: bool,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
}

/// `relief config check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// The file, checked on its own
    pub file: Option<PathBuf>,
}

/// Does what the sub-command says.
pub fn config(command: &ConfigCommand) -> anyhow::Result<Verdict> {
    match command {
        ConfigCommand::Show(args) => show(args),
        ConfigCommand::Check(args) => check(args),
    }
}

fn show(args: &ShowArgs) -> anyhow::Result<Verdict> {
    let places = LayerPlaces::of_machine(args.config.as_deref());
    let layered = LayeredConfig::read(&places, &Overrides::default())?;
    match (args.json, args.origin) {
        (true, true) => writeln!(Stdout, "{}", origins(&layered))?,
        (true, false) => writeln!(Stdout, "{}", serde_json::to_string(&layered.config)?)?,
        (false, true) => {
            for (key, (value, origin)) in layered.entries() {
                writeln!(Stdout, "{key} = {value}  # {origin}")?;
            }
        }
        (false, false) => write!(Stdout, "{}", toml::to_string(&layered.config)?)?,
    }
    Ok(Verdict::Done)
}

fn origins(layered: &LayeredConfig) -> Value {
    let entries = layered.entries().into_iter();
    let object: Map<String, Value> = entries
        .map(|(key, (value, origin))| {
            let entry = json!({"value": value, "origin": origin.to_string()});
            (key, entry)
        })
        .collect();
    Value::Object(object)
}

fn check(args: &CheckArgs) -> anyhow::Result<Verdict> {
    let places = match &args.file {
        Some(file) => LayerPlaces::only(Some(file)),
        None => LayerPlaces::of_machine(None),
    };
    let layered = LayeredConfig::read(&places, &Overrides::default())?;
    for file in &layered.files {
        writeln!(Stdout, "{}: valid", file.display())?;
    }
    let entries = layered.entries();
    let is_set = |origin: &relief::config::Origin| *origin != relief::config::Origin::Default;
    let n_set = entries
        .values()
        .filter(|(_, origin)| is_set(origin))
        .count();
    writeln!(Stdout, "{n_set} of {} keys are set", entries.len())?;
    Ok(Verdict::Done)
}
