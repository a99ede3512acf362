//! The program `relief`: command line in, exit code out.
#![forbid(unsafe_code)]

mod cli;

use clap::Parser;
use cli::{
    Cli, Command, bench, calibrate, config, daemon, devices, evaluate,
    logging::log_to_stderr,
    package, record,
    run::{self, Verdict},
    session, summary,
};
use relief::control::{Progress, Stderr};
use std::{io::Write, process::ExitCode};

/// The system's own kept ever more of what a daemon lets go over hours.
#[cfg(feature = "jemalloc")]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    let cli = Cli::parse();
    let prints_json = cli.command.prints_json();
    let progress = Progress::new(cli.command.progress_style());
    log_to_stderr(cli.log_format, &progress);

    let ran = match &cli.command {
        Command::Run(args) => daemon::run(args),
        Command::Replay(args) => run::replay(args, &progress),
        Command::Refine(args) => run::refine(args, &progress),
        Command::Simulate(args) => run::simulate(args),
        Command::Demo(args) => run::demo(args, &progress),
        Command::Bench(args) => bench::bench(args),
        Command::Evaluate(args) => evaluate::evaluate(args),
        Command::Calibrate(command) => calibrate::calibrate(command),
        Command::Session(command) => session::session(command),
        Command::Devices(args) => devices::devices(args),
        Command::Doctor(args) => devices::doctor(args),
        Command::Record(args) => record::record(args),
        Command::Config(command) => config::config(command),
        Command::Completions(args) => package::completions(args),
        Command::Man(args) => package::man(args),
    };
    let verdict = ran.unwrap_or_else(|error| {
        let told = summary::with_causes(&error);
        if prints_json {
            // That nothing can be printed may be the error.
            let _ = summary::print_error(&told);
        }
        let _ = writeln!(Stderr, "error: {told}");
        Verdict::of_error(&error)
    });
    verdict.into()
}
