//! `depth.txt` and `ir.txt`: which image was taken when, and which of them belong to one moment.

use std::path::{Component, Path};

use depth_camera::CameraError;

use crate::{files::read_ordinary_text, session::invalid};

/// Images at most this far apart belong together; frames of both sensors are 33 ms apart.
pub const SAME_MOMENT_SECS: f64 = 0.010;

/// Timestamps are decimal fractions: the difference of two of them is off by rounding.
const ROUNDING_SECS: f64 = 1e-9;

/// One line of a list.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The device's clock, seconds.
    pub time_secs: f64,
    /// Relative to the session's folder, never leaving it.
    pub file_name: String,
}

/// The images of one moment; at least one is there.
#[derive(Clone, Debug, PartialEq)]
pub struct Moment {
    /// The device's clock, seconds.
    pub time_secs: f64,
    /// The depth image's file, as its list names it.
    pub depth: Option<String>,
    /// The IR image's file, likewise.
    pub ir: Option<String>,
}

/// Reads a list; times increase strictly.
///
/// # Errors
/// [`CameraError::Invalid`] naming file, line and value.
pub fn read_list(path: &Path) -> Result<Vec<Entry>, CameraError> {
    let text = read_ordinary_text(path).map_err(|error| invalid(path, error))?;
    let mut entries: Vec<Entry> = Vec::new();
    for (number, line) in content_lines(&text) {
        let entry = parse_entry(line).map_err(|what| at_line(path, number, what))?;
        if let Some(previous) = entries.last() {
            check_order(previous.time_secs, entry.time_secs)
                .map_err(|what| at_line(path, number, what))?;
        }
        entries.push(entry);
    }
    Ok(entries)
}

/// Joins the two lists by time, in order; a moment of both carries the depth's time. Of several IR images within reach of a depth image
/// the nearest belongs to it, and the others are moments of their own.
pub fn merge_lists(depth: Vec<Entry>, ir: Vec<Entry>) -> Vec<Moment> {
    let mut moments = Vec::with_capacity(depth.len().max(ir.len()));
    let mut ir = ir.into_iter().peekable();
    for depth in depth {
        let apart_secs = |ir: &Entry| (ir.time_secs - depth.time_secs).abs();
        let is_near = |ir: &Entry| apart_secs(ir) <= SAME_MOMENT_SECS + ROUNDING_SECS;
        let mut nearest: Option<Entry> = None;
        while let Some(nearer) = ir.next_if(|ir| {
            let is_nearer = |than: &Entry| apart_secs(ir) < apart_secs(than);
            let is_in_time = ir.time_secs <= depth.time_secs || is_near(ir);
            is_in_time && nearest.as_ref().is_none_or(is_nearer)
        }) {
            moments.extend(nearest.replace(nearer).map(infrared_alone));
        }
        let (partner, earlier) = match nearest {
            Some(ir) if is_near(&ir) => (Some(ir), None),
            earlier => (None, earlier),
        };
        moments.extend(earlier.map(infrared_alone));
        moments.push(Moment {
            time_secs: depth.time_secs,
            depth: Some(depth.file_name),
            ir: partner.map(|entry| entry.file_name),
        });
    }
    moments.extend(ir.map(infrared_alone));
    moments
}

fn infrared_alone(entry: Entry) -> Moment {
    Moment {
        time_secs: entry.time_secs,
        depth: None,
        ir: Some(entry.file_name),
    }
}

/// The lines that say something, without comments, numbered from 1.
pub(crate) fn content_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines()
        .map(|line| line.split_once('#').map_or(line, |(content, _)| content))
        .map(str::trim)
        .zip(1..)
        .filter(|(line, _)| !line.is_empty())
        .map(|(line, number)| (number, line))
}

/// An error that begins with file and line.
pub(crate) fn at_line(path: &Path, number: usize, what: impl std::fmt::Display) -> CameraError {
    invalid(path, format!("line {number}: {what}"))
}

/// Refuses a time that does not come after the one before.
pub(crate) fn check_order(previous_secs: f64, time_secs: f64) -> Result<(), String> {
    if time_secs > previous_secs {
        return Ok(());
    }
    Err(format!(
        "timestamp {time_secs} follows {previous_secs}, must be later"
    ))
}

fn parse_entry(line: &str) -> Result<Entry, String> {
    let (time, name) = line
        .split_once(char::is_whitespace)
        .ok_or_else(|| format!("\"{line}\" must be a timestamp and a file name"))?;
    let file_name = name.trim().to_owned();
    let stays_inside = Path::new(&file_name)
        .components()
        .all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    if !stays_inside {
        return Err(format!(
            "file name \"{file_name}\" must be relative and stay in the session's folder"
        ));
    }
    let time_secs = parse_time(time)?;
    Ok(Entry {
        time_secs,
        file_name,
    })
}

/// A timestamp in seconds.
pub(crate) fn parse_time(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(time_secs) if time_secs.is_finite() => Ok(time_secs),
        _ => Err(format!(
            "timestamp \"{text}\" must be a finite number of seconds"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(times: &[f64], folder: &str) -> Vec<Entry> {
        times
            .iter()
            .map(|&time_secs| Entry {
                time_secs,
                file_name: format!("{folder}/{time_secs}"),
            })
            .collect()
    }

    #[test]
    fn images_within_ten_milliseconds_share_a_moment() {
        let depth = entries(&[100.0, 100.033, 100.067], "depth");
        let ir = entries(&[99.9, 100.043, 100.2], "ir");
        let moments = merge_lists(depth, ir);
        let found: Vec<_> = moments
            .iter()
            .map(|m| (m.time_secs, m.depth.is_some(), m.ir.is_some()))
            .collect();
        assert_eq!(
            found,
            [
                (99.9, false, true),
                (100.0, true, false),
                (100.033, true, true),
                (100.067, true, false),
                (100.2, false, true),
            ]
        );
    }

    #[test]
    fn of_several_images_within_reach_the_nearest_shares_the_moment_and_time_never_goes_back() {
        let depth = entries(&[100.0, 100.033, 100.066], "depth");
        let ir = [
            99.991, 99.995, 100.003, 100.006, 100.024, 100.04, 100.042, 100.07,
        ];
        let moments = merge_lists(depth, entries(&ir, "ir"));
        let found: Vec<_> = moments
            .iter()
            .map(|m| (m.time_secs, m.depth.is_some(), m.ir.as_deref()))
            .collect();
        assert_eq!(
            found,
            [
                (99.991, false, Some("ir/99.991")),
                (99.995, false, Some("ir/99.995")),
                (100.0, true, Some("ir/100.003")),
                (100.006, false, Some("ir/100.006")),
                (100.024, false, Some("ir/100.024")),
                (100.033, true, Some("ir/100.04")),
                (100.042, false, Some("ir/100.042")),
                (100.066, true, Some("ir/100.07")),
            ]
        );
        assert!(moments.is_sorted_by(|a, b| a.time_secs < b.time_secs));
    }

    #[test]
    fn comments_and_blank_lines_keep_their_numbers() {
        let lines: Vec<_> = content_lines("# head\n\n1.0 a.png # note\n2.0 b.png\r\n").collect();
        assert_eq!(lines, [(3, "1.0 a.png"), (4, "2.0 b.png")]);
    }
}
