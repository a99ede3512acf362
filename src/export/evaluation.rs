//! The report of an evaluation: Markdown, JSON, and pictures beside them.

use super::{
    ExportError, atomic::write_atomically, colour_scale::ColourScale, encode_png_rgb,
    encode_png_rgba,
};
use depth_camera::Image;
use serde::Serialize;
use std::{fmt::Write as _, fs, io::Write, path::Path};

/// How refinement explains images that it was not made from.
#[derive(Clone, Debug, Serialize)]
pub struct EvaluationReport {
    /// Name of the scan.
    pub session: String,
    /// Both surfaces against a measured one, if there is one.
    pub truth: Option<AgainstTruth>,
    /// Refinements made, each without its share of the views; none if no views were left out.
    pub n_folds: usize,
    /// All views together.
    pub overall: LeftOutView,
    /// Each view.
    pub views: Vec<LeftOutView>,
    /// Why no views are judged, if one of the folds came to nothing.
    pub not_judged_reason: Option<String>,
    /// The same with something changed.
    pub ablations: Vec<Ablation>,
    /// Why the refined mesh is not delivered, if it is not.
    pub not_refined_reason: Option<String>,
    /// The pictures.
    #[serde(skip)]
    pub pictures: EvaluationPictures,
}

/// Base and refined surface against a measured one.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct AgainstTruth {
    /// The object of the base mesh.
    pub base: TruthFigures,
    /// The refined mesh, if it is delivered.
    pub refined: Option<TruthFigures>,
}

/// How far a surface is from a measured one, after the best rigid alignment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TruthFigures {
    /// Points compared.
    pub n_points: usize,
    /// Mean distance, millimetres.
    pub mean_mm: f64,
    /// Median distance, millimetres.
    pub median_mm: f64,
    /// Root mean square distance, millimetres.
    pub rms_mm: f64,
    /// Root mean square of the signed distance less its mean within 8 mm, millimetres.
    pub detail_rms_mm: f64,
    /// Mean angle between normals, degrees.
    pub normal_mean_deg: f64,
    /// Median angle between normals, degrees.
    pub normal_median_deg: f64,
    /// Share of the truth that was seen and has surface within 2 mm.
    pub completeness: f64,
}

/// A view that was left out: root mean squares as shares of its mean observed linear intensity, NaN where no pixel was compared.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct LeftOutView {
    /// Its frame; `None` for several views together.
    pub frame_id: Option<u64>,
    /// Pixels compared.
    pub n_pixels: usize,
    /// Error of the intensity: base mesh, refined mesh, noise of the sensor.
    pub intensity: [f64; 3],
    /// Error of its gradient per pixel, in the same order.
    pub gradient: [f64; 3],
}

/// One variation.
#[derive(Clone, Debug, Serialize)]
pub struct Ablation {
    /// What was changed.
    pub what: String,
    /// What came of it.
    #[serde(flatten)]
    pub outcome: AblationOutcome,
}

/// What came of a variation.
#[derive(Clone, Debug, Serialize)]
#[serde(untagged)]
pub enum AblationOutcome {
    /// It is judged.
    Judged {
        /// All judging views together.
        figures: LeftOutView,
        /// Root mean square of the gains, less 1, that took up slow differences of brightness.
        slow_gain: f64,
        /// Processor time of preparing, refining and judging, all threads together.
        cpu_secs: f64,
    },
    /// It came to nothing.
    Failed {
        /// Why.
        not_judged_reason: String,
    },
}

/// What is shown.
#[derive(Clone, Debug, Default)]
pub struct EvaluationPictures {
    /// The base mesh, shaded.
    pub base: Option<Image<[u8; 3]>>,
    /// The refined mesh, shaded.
    pub refined: Option<Image<[u8; 3]>>,
    /// Observed less rendered linear intensity of a view, on base and refined surface; NaN where not compared.
    pub error_maps: Option<[Image<f32>; 2]>,
    /// That view's frame.
    pub error_frame_id: Option<u64>,
}

/// Full colour of an error map, share of full scale.
const ERROR_LIMIT: f64 = 0.1;

/// Writes `evaluation.md`, `evaluation.json` and the pictures into a folder.
///
/// # Errors
/// [`ExportError::Write`] if a file cannot be written.
pub fn write_evaluation(folder: &Path, report: &EvaluationReport) -> Result<(), ExportError> {
    let images = folder.join("images");
    fs::create_dir_all(&images).map_err(|cause| ExportError::write(&images, cause))?;
    let EvaluationPictures {
        base,
        refined,
        error_maps,
        ..
    } = &report.pictures;
    for (name, picture) in [("base.png", base), ("refined.png", refined)] {
        if let Some(picture) = picture {
            write_atomically(&images.join(name), |file| {
                file.write_all(&encode_png_rgb(picture)?)
            })?;
        }
    }
    let scale = ColourScale::symmetric(ERROR_LIMIT);
    for (name, map) in ["error-base.png", "error-refined.png"]
        .iter()
        .zip(error_maps.iter().flatten())
    {
        let picture = map.map(|&error| scale.colour(f64::from(error)));
        write_atomically(&images.join(name), |file| {
            file.write_all(&encode_png_rgba(&picture)?)
        })?;
    }
    write_atomically(&folder.join("evaluation.json"), |file| {
        serde_json::to_writer_pretty(&mut *file, report)?;
        file.write_all(b"\n")
    })?;
    write_atomically(&folder.join("evaluation.md"), |file| {
        file.write_all(markdown(report).as_bytes())
    })
}

fn markdown(report: &EvaluationReport) -> String {
    let mut text = format!("# Evaluation of {}\n\n", report.session);
    let mut line = |line: &str| {
        // Writing into a string does not fail.
        let _ = writeln!(text, "{line}");
    };
    if let Some(truth) = &report.truth {
        against_truth(truth, &mut line);
    }
    if let Some(reason) = &report.not_refined_reason {
        line(&format!("The refined mesh is not delivered: {reason}.\n"));
    }
    match &report.not_judged_reason {
        Some(reason) => line(&format!("The views left out are not judged: {reason}.\n")),
        None if report.n_folds > 0 => left_out(report, &mut line),
        None => {}
    }
    if !report.ablations.is_empty() {
        with_something_changed(&report.ablations, &mut line);
    }
    line("\n## Pictures\n");
    let pictures = &report.pictures;
    for (name, what, is_there) in [
        ("base", "base mesh", pictures.base.is_some()),
        ("refined", "refined mesh", pictures.refined.is_some()),
    ] {
        if is_there {
            line(&format!("![{what}](images/{name}.png)"));
        }
    }
    if let Some(frame_id) = pictures.error_frame_id {
        line(&format!(
            "\nObserved less rendered intensity of frame {frame_id}, base mesh and refined mesh; red and blue are {ERROR_LIMIT} of full \
             scale:\n\n![base](images/error-base.png) ![refined](images/error-refined.png)"
        ));
    }
    text
}

/// Every view that was left out.
fn left_out(report: &EvaluationReport, line: &mut impl FnMut(&str)) {
    line(&format!(
        "Views left out in {} folds, rendered pixel by pixel from base and refined mesh and compared with what the sensor saw: root mean \
         squares as shares of the mean linear intensity.\n",
        report.n_folds
    ));
    line(&format!("| frame | {COLUMNS}"));
    line(&format!("|---|{RULE}"));
    for view in &report.views {
        let name = view
            .frame_id
            .map_or_else(String::new, |frame_id| frame_id.to_string());
        line(&row(&name, view));
    }
    line(&row("all", &report.overall));
}

/// Every variation, and below them why some came to nothing.
fn with_something_changed(ablations: &[Ablation], line: &mut impl FnMut(&str)) {
    line(
        "\n## With something changed\n\nAll judged by the same quarter of the views, none of which was learnt from.\n",
    );
    line(&format!("| changed | {COLUMNS} slow gain | processor s |"));
    line(&format!("|---|{RULE}---|---|"));
    for ablation in ablations {
        if let AblationOutcome::Judged {
            figures,
            slow_gain,
            cpu_secs,
        } = &ablation.outcome
        {
            let row = row(&ablation.what, figures);
            let slow_gain = number(*slow_gain, 3);
            line(&format!("{row} {slow_gain} | {cpu_secs:.1} |"));
        }
    }
    for ablation in ablations {
        if let AblationOutcome::Failed { not_judged_reason } = &ablation.outcome {
            let what = &ablation.what;
            line(&format!("\nNot judged: {what}: {not_judged_reason}."));
        }
    }
}

/// Distances to the truth, in the columns of `TruthFigures`.
fn against_truth(truth: &AgainstTruth, line: &mut impl FnMut(&str)) {
    line(
        "Against the measured surface, after the best rigid alignment; detail is the signed distance less its mean within 8 mm.\n",
    );
    line(
        "| mesh | points | mean mm | median mm | RMS mm | detail RMS mm | normals mean ° | median ° | complete within 2 mm % |",
    );
    line("|---|---|---|---|---|---|---|---|---|");
    let mut row = |name: &str, f: &TruthFigures| {
        line(&format!(
            "| {name} | {} | {:.3} | {:.3} | {:.3} | {:.4} | {:.2} | {:.2} | {:.1} |",
            f.n_points,
            f.mean_mm,
            f.median_mm,
            f.rms_mm,
            f.detail_rms_mm,
            f.normal_mean_deg,
            f.normal_median_deg,
            100.0 * f.completeness
        ));
    };
    row("base", &truth.base);
    if let Some(refined) = &truth.refined {
        row("refined", refined);
        let change = |before: f64, after: f64| 100.0 * (after / before - 1.0);
        line(&format!(
            "\nDistance {:+.1} %, detail {:+.1} %, normals {:+.1} %.",
            change(truth.base.mean_mm, refined.mean_mm),
            change(truth.base.detail_rms_mm, refined.detail_rms_mm),
            change(truth.base.normal_mean_deg, refined.normal_mean_deg)
        ));
    }
    line("");
}

const COLUMNS: &str =
    "pixels | intensity base % | refined % | noise % | gradient base % | refined % | noise % |";
const RULE: &str = "---|---|---|---|---|---|---|";

fn row(name: &str, view: &LeftOutView) -> String {
    let mut text = format!("| {name} | {} |", view.n_pixels);
    for share in view.intensity.iter().chain(&view.gradient) {
        // Writing into a string does not fail.
        let _ = write!(text, " {} |", number(100.0 * share, 2));
    }
    text
}

/// A number with so many decimals; a dash for one that does not exist.
fn number(value: f64, decimals: usize) -> String {
    match value.is_nan() {
        true => "–".to_owned(),
        false => format!("{value:.decimals$}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_that_judges_nothing_has_no_figures() {
        let nothing = LeftOutView {
            frame_id: Some(3),
            n_pixels: 0,
            intensity: [f64::NAN; 3],
            gradient: [f64::NAN; 3],
        };
        assert_eq!(row("3", &nothing), "| 3 | 0 | – | – | – | – | – | – |");
    }

    #[test]
    fn figures_and_pictures_stand_in_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let view = LeftOutView {
            frame_id: Some(17),
            n_pixels: 1234,
            intensity: [0.1, 0.05, 0.01],
            gradient: [0.08, 0.04, 0.012],
        };
        let report = EvaluationReport {
            session: "pot".into(),
            truth: Some(AgainstTruth {
                base: TruthFigures {
                    mean_mm: 0.8,
                    detail_rms_mm: 0.2,
                    normal_mean_deg: 10.0,
                    ..TruthFigures::default()
                },
                refined: Some(TruthFigures {
                    mean_mm: 0.6,
                    detail_rms_mm: 0.1,
                    normal_mean_deg: 11.0,
                    ..TruthFigures::default()
                }),
            }),
            n_folds: 4,
            overall: LeftOutView {
                frame_id: None,
                ..view
            },
            views: vec![view],
            not_judged_reason: None,
            ablations: vec![
                Ablation {
                    what: "1 views".into(),
                    outcome: AblationOutcome::Failed {
                        not_judged_reason: "none sees it".into(),
                    },
                },
                Ablation {
                    what: "3 views".into(),
                    outcome: AblationOutcome::Judged {
                        figures: view,
                        slow_gain: 0.021,
                        cpu_secs: 12.34,
                    },
                },
            ],
            not_refined_reason: None,
            pictures: EvaluationPictures {
                error_maps: Some([Image::filled(3, 2, 0.01), Image::filled(3, 2, f32::NAN)]),
                error_frame_id: Some(17),
                ..EvaluationPictures::default()
            },
        };
        write_evaluation(folder.path(), &report).unwrap();
        let text = fs::read_to_string(folder.path().join("evaluation.md")).unwrap();
        assert!(
            text.contains("| 17 | 1234 | 10.00 | 5.00 | 1.00 | 8.00 | 4.00 | 1.20 |"),
            "{text}"
        );
        assert!(
            text.contains("| 3 views |") && text.contains(" 0.021 | 12.3 |"),
            "{text}"
        );
        assert!(
            text.contains("Distance -25.0 %, detail -50.0 %, normals +10.0 %."),
            "{text}"
        );
        assert!(folder.path().join("images/error-base.png").is_file());
        assert!(
            !folder.path().join("images/base.png").exists() && !text.contains("base.png)\n![ref")
        );
        let json: serde_json::Value =
            serde_json::from_slice(&fs::read(folder.path().join("evaluation.json")).unwrap())
                .unwrap();
        assert_eq!(json["views"][0]["intensity"][1], 0.05);
        assert!(
            text.contains("\nNot judged: 1 views: none sees it."),
            "{text}"
        );
        let ablations = &json["ablations"];
        assert_eq!(ablations[0]["not_judged_reason"], "none sees it");
        assert_eq!(ablations[1]["figures"]["n_pixels"], 1234);
        assert!(ablations[1].get("not_judged_reason").is_none());
    }
}
