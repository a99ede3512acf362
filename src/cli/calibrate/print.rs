//! What a calibration found, on standard output: text, or one JSON object.

use super::findings::Findings;
use crate::cli::stdout::Stdout;
use relief::{
    calibrate::{InverseSquare, Measured},
    export::CalibrationResult,
};
use serde_json::json;
use std::{collections::BTreeMap, io::Write};

/// Prints what was found, and what of it could not be written, as one JSON object.
///
/// # Errors
/// If it cannot be printed.
pub fn print_json(findings: &Findings, failures: &[String]) -> anyhow::Result<()> {
    let object = serde_json::to_string(&machine_readable(findings, failures))?;
    writeln!(Stdout, "{object}")?;
    Ok(())
}

/// Prints what was found as text.
///
/// # Errors
/// If it cannot be printed.
pub fn print_text(findings: &Findings) -> anyhow::Result<()> {
    for session in findings.sessions() {
        writeln!(
            Stdout,
            "{}: {}, {} images, {} samples, {:.2} % off the model ({:.2} % is noise), {:.1} % outliers",
            session.name,
            session.target,
            session.n_images,
            session.n_samples,
            session.deviation * 100.0,
            session.noise * 100.0,
            session.outlier_share * 100.0
        )?;
    }
    for CalibrationResult {
        name,
        value,
        remark,
    } in findings.results()
    {
        match remark.as_str() {
            "" => writeln!(Stdout, "{name:<36}{value}")?,
            remark => writeln!(Stdout, "{name:<36}{value}   ({remark})")?,
        }
    }
    for remark in findings.remarks() {
        writeln!(Stdout, "note: {remark}")?;
    }
    writeln!(Stdout, "intervals are of 95 %")?;
    Ok(())
}

fn machine_readable(findings: &Findings, failures: &[String]) -> serde_json::Value {
    let measured = |m: &Measured| json!({"value": m.value, "half_interval_95": m.half_width()});
    let estimate = &findings.estimate;
    let (gamma, _) = findings.independent_gamma();
    let (flat_rms, flat_corner) = findings.flat_uncertainty();
    let exponents: BTreeMap<&str, serde_json::Value> = findings
        .distances
        .iter()
        .map(|(index, law)| {
            let exponent = InverseSquare::exponent(&law.product, &gamma);
            let value = json!({
                "exponent": measured(&exponent),
                "gamma_times_exponent": measured(&law.product),
                "range_m": law.range_m,
            });
            (findings.scans[*index].name.as_str(), value)
        })
        .collect();
    let spheres: BTreeMap<&str, serde_json::Value> = findings
        .responses
        .iter()
        .map(|(index, check)| {
            let value = json!({
                "radius_m": estimate.radius(*index).as_ref().map(measured),
                "share_within": check.within,
                "share_within_unmasked": check.within_unmasked,
                "masked_share": check.masked_share,
                "plain_gamma": check.plain.gamma,
                "plain_share_within": check.plain.inlier_share,
            });
            (findings.scans[*index].name.as_str(), value)
        })
        .collect();
    let status = match failures {
        [] => "complete",
        _ => "failed",
    };
    json!({
        "status": status,
        "failures": failures,
        "gamma": measured(&estimate.gamma()),
        "gamma_of_spheres_alone": findings.spheres_alone.as_ref().map(|e| measured(&e.gamma())),
        "light_position_m": estimate.light_position().iter().map(measured).collect::<Vec<_>>(),
        "light_told": findings.axes_told(),
        "lobe_power": measured(&estimate.lobe_power()),
        "flat_field": estimate.flat_is_measured.then(|| json!({"sigma_rms": flat_rms, "sigma_corners": flat_corner})),
        "walls": exponents,
        "spheres": spheres,
        "notes": findings.remarks(),
    })
}
