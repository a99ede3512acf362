//! Log lines on standard error, for a terminal, the journal or a program.

use clap::ValueEnum;
use relief::control::Progress;
use std::{
    env,
    ffi::OsString,
    fmt, fs,
    io::{self, IsTerminal},
    os::unix::fs::MetadataExt,
};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::{
    EnvFilter,
    fmt::{FmtContext, FormatEvent, FormatFields, format},
    registry::LookupSpan,
};

/// How log lines are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Lines for people
    #[default]
    Text,
    /// A JSON object a line
    Json,
}

/// What is logged where nothing else is said.
const DEFAULT: &str = "info";

/// Sends log lines to standard error, at `info` unless `RUST_LOG` says otherwise. The journal stamps them with the time and is
/// told their priority.
pub fn log_to_stderr(log_format: LogFormat, progress: &Progress) {
    let said = env::var_os(EnvFilter::DEFAULT_ENV);
    let filter = said.map_or_else(|| Ok(EnvFilter::new(DEFAULT)), filter_of);
    let (filter, refused) = match filter {
        Ok(filter) => (filter, None),
        Err(refused) => (EnvFilter::new(DEFAULT), Some(refused)),
    };
    let is_journal = is_journal();
    let lines = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(io::stderr().is_terminal() && log_format == LogFormat::Text)
        .with_writer(progress.log_writer())
        // They would be told on standard error, by what panics where that cannot be written.
        .log_internal_errors(false);
    match (log_format, is_journal) {
        (LogFormat::Text, false) => lines.without_time().init(),
        (LogFormat::Text, true) => lines
            .event_format(ForJournal(
                format().without_time().with_target(false).with_level(false),
            ))
            .init(),
        (LogFormat::Json, false) => lines.json().init(),
        (LogFormat::Json, true) => lines.json().without_time().init(),
    }
    if let Some(refused) = refused {
        tracing::warn!("{}: {refused}; logged is {DEFAULT}", EnvFilter::DEFAULT_ENV);
    }
}

/// The filter that a text says, or what is wrong with that.
fn filter_of(said: OsString) -> Result<EnvFilter, String> {
    let told = |what: String| format!("{said:?}: {what}");
    let text = said.to_str().ok_or_else(|| told("no UTF-8".to_owned()))?;
    EnvFilter::try_new(text).map_err(|error| told(error.to_string()))
}

/// Whether standard error is the journal's, and not a file or pipe that somebody has put in its place.
fn is_journal() -> bool {
    let stream = env::var("JOURNAL_STREAM");
    let stderr = fs::metadata("/proc/self/fd/2");
    match (stream, stderr) {
        (Ok(stream), Ok(stderr)) => stream == format!("{}:{}", stderr.dev(), stderr.ino()),
        _ => false,
    }
}

/// Lines with their priority before them, as `sd-daemon(3)` has it.
struct ForJournal<F>(F);

impl<S, N, F> FormatEvent<S, N> for ForJournal<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: format::Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        write!(writer, "<{}>", priority(*event.metadata().level()))?;
        self.0.format_event(context, writer, event)
    }
}

/// The priority of `syslog(3)`.
fn priority(level: Level) -> u8 {
    match level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        Level::DEBUG | Level::TRACE => 7,
    }
}
