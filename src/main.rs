//! The program `relief`: command line in, exit code out.
#![forbid(unsafe_code)]

mod cli;

use clap::Parser;
use cli::{
    Cli, Command, bench, calibrate, evaluate,
    run::{self, Verdict},
    session, summary,
};
use relief::control::{Progress, ProgressStyle};
use std::{
    io::{self, IsTerminal},
    process::ExitCode,
};
use tracing_subscriber::{EnvFilter, fmt};

fn main() -> ExitCode {
    let cli = Cli::parse();
    let prints_json = cli.command.prints_json();
    let progress = Progress::new(match prints_json {
        true => ProgressStyle::Silent,
        false => ProgressStyle::of_stderr(),
    });
    log_to_stderr(&progress);

    let ran = match &cli.command {
        Command::Replay(args) => run::replay(args, &progress),
        Command::Refine(args) => run::refine(args, &progress),
        Command::Simulate(args) => run::simulate(args),
        Command::Demo(args) => run::demo(args, &progress),
        Command::Bench(args) => bench::bench(args),
        Command::Evaluate(args) => evaluate::evaluate(args),
        Command::Calibrate(command) => calibrate::calibrate(command),
        Command::Session(command) => session::session(command),
    };
    let verdict = ran.unwrap_or_else(|error| {
        if prints_json {
            summary::print_error(&error);
        }
        eprintln!("error: {error:#}");
        Verdict::of_error(&error)
    });
    verdict.into()
}

/// Sends log lines to standard error, at `info` unless `RUST_LOG` says otherwise.
fn log_to_stderr(progress: &Progress) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    fmt()
        .with_env_filter(filter)
        .with_target(false)
        .without_time()
        .with_ansi(io::stderr().is_terminal())
        .with_writer(progress.log_writer())
        .init();
}
