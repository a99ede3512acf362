//! `metadata.yaml`, with which rosbag2 and its readers take the folder for a bag.

use std::{
    collections::BTreeMap,
    fmt::{self, Write as _},
    io::Write as _,
    path::Path,
};

use crate::{error::RecordingError, segment::SegmentSummary};

/// The name of the file.
pub const FILE_NAME: &str = "metadata.yaml";

/// Writes the description of a bag of so many files, whole or not at all.
///
/// # Errors
/// What the system says.
pub fn write(folder: &Path, segments: &[(String, SegmentSummary)]) -> Result<(), RecordingError> {
    let text = text(segments).map_err(|error| RecordingError::invalid(folder, error))?;
    replay::write_whole_file(&folder.join(FILE_NAME), |out| {
        out.write_all(text.as_bytes())
    })?;
    Ok(())
}

/// Version 5 of the format, which every release since Humble reads. Names hold letters, digits, `_`, `-`, `.` and `/` alone.
fn text(segments: &[(String, SegmentSummary)]) -> Result<String, fmt::Error> {
    let mut topics = BTreeMap::new();
    for (_, segment) in segments {
        for (topic, (message_type, n)) in &segment.topics {
            topics.entry(topic).or_insert((message_type, 0)).1 += n;
        }
    }
    let times = segments.iter().filter_map(|(_, segment)| segment.time_ns);
    let (start, end) = times
        .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
        .unwrap_or_default();
    let n_messages: u64 = segments.iter().map(|(_, s)| s.n_messages()).sum();

    let mut out = String::new();
    writeln!(out, "rosbag2_bagfile_information:")?;
    writeln!(out, "  version: 5")?;
    writeln!(out, "  storage_identifier: mcap")?;
    writeln!(out, "  duration:\n    nanoseconds: {}", end - start)?;
    writeln!(out, "  starting_time:")?;
    writeln!(out, "    nanoseconds_since_epoch: {start}")?;
    writeln!(out, "  message_count: {n_messages}")?;
    writeln!(out, "  topics_with_message_count:")?;
    for (topic, (message_type, n)) in topics {
        writeln!(out, "    - topic_metadata:")?;
        writeln!(out, "        name: {topic}")?;
        writeln!(out, "        type: {message_type}")?;
        writeln!(out, "        serialization_format: cdr")?;
        writeln!(out, "        offered_qos_profiles: \"\"")?;
        writeln!(out, "      message_count: {n}")?;
    }
    writeln!(out, "  compression_format: \"\"")?;
    writeln!(out, "  compression_mode: \"\"")?;
    writeln!(out, "  relative_file_paths:")?;
    for (name, _) in segments {
        writeln!(out, "    - {name}")?;
    }
    writeln!(out, "  files:")?;
    for (name, segment) in segments {
        let (start, end) = segment.time_ns.unwrap_or_default();
        writeln!(out, "    - path: {name}")?;
        writeln!(out, "      starting_time:")?;
        writeln!(out, "        nanoseconds_since_epoch: {start}")?;
        writeln!(out, "      duration:\n        nanoseconds: {}", end - start)?;
        writeln!(out, "      message_count: {}", segment.n_messages())?;
    }
    Ok(out)
}
