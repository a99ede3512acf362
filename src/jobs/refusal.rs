//! Why a refinement was refused, in the report of the scan, which was written before anybody knew.

use super::{JobError, spool};
use crate::{atomic_file::write_atomically, pipeline::REPORT_JSON};
use serde_json::{Map, Value};
use std::{
    fs,
    io::{self, Write},
    path::Path,
};

/// The field of the report.
const FIELD: &str = "refinement_refused_reason";

/// Adds the reason to a scan's report, in the place of that of an earlier refinement; all else of the report stays as it is. A scan
/// without a report, as one that was written down on the way, gets none.
///
/// # Errors
/// If the system refuses, or what is there is no report; it is then left alone.
pub fn note_refusal(scan: &Path, reason: &str) -> Result<(), JobError> {
    let path = scan.join(REPORT_JSON);
    match fs::read_to_string(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        read => read
            .and_then(|report| Ok(with_reason(&report, reason)?))
            .and_then(|report| write_atomically(&path, |file| file.write_all(report.as_bytes())))
            .map_err(spool::at(&path)),
    }
}

/// A report with the reason as its last field, put in as text: to read and write its numbers anew might change their last digits.
fn with_reason(report: &str, reason: &str) -> serde_json::Result<String> {
    // Within a string of JSON no line ends.
    let field = format!(",\n  \"{FIELD}\": ");
    let report = report.trim_end();
    let fields = match report.split_once(&field) {
        Some((before, _)) => before,
        None => report.strip_suffix('}').unwrap_or(report).trim_end(),
    };
    let text = format!("{fields}{field}{}\n}}\n", serde_json::to_string(reason)?);
    serde_json::from_str::<Map<String, Value>>(&text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::scenes::scan;

    #[test]
    fn a_report_gets_the_newest_reason_and_loses_nothing() {
        let root = tempfile::tempdir().unwrap();
        let scan = scan(root.path(), "a");
        let path = scan.join(REPORT_JSON);
        note_refusal(&scan, "too dark").unwrap();
        assert!(!path.exists(), "there was none");

        let fields = "{\n  \"relief_report\": 1,\n  \"area_m2\": 0.30000000000000004,\n  \"tracking\": {\n    \"lost\": 2\n  }";
        fs::write(&path, format!("{fields}\n}}\n")).unwrap();
        for (reason, text) in [
            ("too \"dark\"\n", r#""too \"dark\"\n""#),
            ("too bright", r#""too bright""#),
        ] {
            note_refusal(&scan, reason).unwrap();
            let expected = format!("{fields},\n  \"{FIELD}\": {text}\n}}\n");
            assert_eq!(fs::read_to_string(&path).unwrap(), expected);
        }
        for damaged in ["", "{", "[]", "7"] {
            fs::write(&path, damaged).unwrap();
            note_refusal(&scan, "too dark").unwrap_err();
            assert_eq!(fs::read_to_string(&path).unwrap(), damaged);
        }
    }
}
