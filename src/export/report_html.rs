//! The report as a page: one HTML file with everything in it, readable on a desk and on a phone, without scripts.
//!
//! This file puts it together; `report_sections` and `report_refinement` hold what stands in it, `page` what is around it.

use super::{
    ExportError, Report,
    atomic::write_atomically,
    colour_scale::{ColourScale, Described},
    encode_png_grey8, encode_png_rgb,
    page::{data_address, document},
    report_refinement as refining, report_sections as sections,
};
use depth_camera::Image;
use maud::{Markup, html};
use rayon::prelude::*;
use std::{
    io::{self, Write},
    path::Path,
};

/// The pictures of a report; all may be empty.
#[derive(Clone, Debug, Default)]
pub struct ReportPictures {
    /// Views of the base mesh, named front, left and right in this order.
    pub base: Vec<Image<[u8; 3]>>,
    /// The same views of the refined mesh.
    pub refined: Vec<Image<[u8; 3]>>,
    /// Shading images, each with its caption.
    pub thumbnails: Vec<(String, Image<u8>)>,
    /// A depth image, already as grey.
    pub depth_thumbnail: Option<Image<u8>>,
    /// What is known of the refined mesh, seen from the front.
    pub fields: Vec<SurfaceField>,
}

/// Numbers on the surface, drawn from one side.
#[derive(Clone, Debug)]
pub struct SurfaceField {
    /// Name and unit.
    pub title: &'static str,
    /// What is to be known beside.
    pub caption: String,
    /// The numbers; NaN where there is no surface.
    pub values: Image<f32>,
    /// The ends of the colours.
    pub range: [f64; 2],
    /// From the numbers to what stands at the colours, such as 1000 for millimetres.
    pub factor: f64,
}

/// Writes a report as one HTML file that refers to nothing outside itself.
///
/// # Errors
/// [`ExportError::Write`] if a picture has no pixels or the file cannot be written.
pub fn write_report_html(
    path: &Path,
    report: &Report,
    pictures: &ReportPictures,
) -> Result<(), ExportError> {
    write_atomically(path, |file| {
        let page = page(report, &EncodedPictures::new(pictures)?);
        file.write_all(page.into_string().as_bytes())
    })
}

/// The pictures as `data:` addresses.
pub(super) struct EncodedPictures {
    pub base: Vec<String>,
    pub refined: Vec<String>,
    pub thumbnails: Vec<(String, String)>,
    pub depth: Option<String>,
    pub fields: Vec<Markup>,
}

impl EncodedPictures {
    fn new(pictures: &ReportPictures) -> io::Result<Self> {
        let rgb = |image: &Image<[u8; 3]>| encode_png_rgb(image).map(|png| data_address(&png));
        let grey = |image: &Image<u8>| encode_png_grey8(image).map(|png| data_address(&png));
        let thumbnail =
            |(caption, image): &(String, Image<u8>)| Ok((caption.clone(), grey(image)?));
        let ReportPictures {
            base,
            refined,
            thumbnails,
            depth_thumbnail,
            fields,
        } = pictures;
        Ok(EncodedPictures {
            base: base.par_iter().map(rgb).collect::<io::Result<_>>()?,
            refined: refined.par_iter().map(rgb).collect::<io::Result<_>>()?,
            thumbnails: thumbnails
                .par_iter()
                .with_max_len(1)
                .map(thumbnail)
                .collect::<io::Result<_>>()?,
            depth: depth_thumbnail.as_ref().map(grey).transpose()?,
            fields: fields.par_iter().map(field).collect::<io::Result<_>>()?,
        })
    }
}

/// A picture of a field with its colours.
fn field(field: &SurfaceField) -> io::Result<Markup> {
    let [low, high] = field.range;
    let described = Described {
        title: field.title,
        alt: format!("{} on the refined mesh, from the front", field.title),
        caption: field.caption.clone(),
        factor: field.factor,
    };
    ColourScale::sequential(low, high).figure(&field.values, &described)
}

fn page(report: &Report, pictures: &EncodedPictures) -> Markup {
    let parts = html! {
        (sections::heading(report))
        (sections::not_refined(report))
        (sections::warnings(report))
        (sections::key_figures(report))
        (sections::surface(report, pictures))
        @if let Some(refined) = &report.refined_mesh {
            (refining::refinement(refined, pictures))
            (refining::views(refined))
        }
        (sections::images(pictures))
        (sections::capture(report))
        (sections::timings(report))
        (sections::outputs(report))
        footer { "Relief " (report.relief_version) }
    };
    document(&format!("{} – scan report", report.session), &parts)
}

#[cfg(test)]
mod tests {
    use super::super::{
        BaseMesh, Evidence, FrameCounts, Iteration, LostSpan, RefinedMesh, RefinedView, Remeshing,
        StageTiming, Tracking, page::assert_self_contained,
    };
    use super::*;

    fn report() -> Report {
        Report {
            session: "vase <3>".into(),
            sensor: "kinect2".into(),
            serial: "0123".into(),
            relief_version: "0.1.0".into(),
            tracking: Tracking {
                path_length_m: 2.5,
                n_relocalised: 0,
                n_unpolished: 0,
                lost_spans: vec![LostSpan::default()],
            },
            base_mesh: BaseMesh {
                faces: 12_345,
                ..BaseMesh::default()
            },
            warnings: vec!["the light is not calibrated".into()],
            timings: vec![StageTiming {
                name: "fuse".into(),
                ..StageTiming::default()
            }],
            outputs: vec!["out/refined.ply".into()],
            ..Report::default()
        }
    }

    fn refined() -> RefinedMesh {
        let iteration = Iteration {
            energy_before: 2e5,
            energy_after: 1e5,
            ..Iteration::default()
        };
        let view = RefinedView {
            frame_id: 42,
            rmse_before: 0.04,
            rmse_after: 0.02,
            ..RefinedView::default()
        };
        RefinedMesh {
            status: "converged".into(),
            iterations: vec![iteration; 3],
            views: vec![view; 2],
            rmse_before: 0.04,
            rmse_after: 0.02,
            evidence: Evidence {
                unseen_share: 0.1,
                ..Evidence::default()
            },
            remeshing: Remeshing {
                hausdorff_m: 0.00123,
                ..Remeshing::default()
            },
            ..RefinedMesh::default()
        }
    }

    fn written(report: &Report, pictures: &ReportPictures) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.html");
        write_report_html(&path, report, pictures).unwrap();
        std::fs::read_to_string(&path).unwrap()
    }

    #[test]
    fn a_refined_scan_has_all_sections_and_nothing_from_outside() {
        let report = Report {
            refined_mesh: Some(refined()),
            ..report()
        };
        let picture = Image::filled(8, 6, [200u8; 3]);
        let pictures = ReportPictures {
            base: vec![picture.clone(); 3],
            refined: vec![picture; 3],
            thumbnails: vec![("frame 42".into(), Image::filled(4, 3, 9u8))],
            depth_thumbnail: Some(Image::filled(4, 3, 90u8)),
            fields: vec![SurfaceField {
                title: "Coverage",
                caption: "of the worst known tilt".into(),
                values: Image::filled(4, 3, 0.5f32),
                range: [0.0, 1.0],
                factor: 1.0,
            }],
        };
        let page = written(&report, &pictures);
        for id in [
            "summary",
            "warnings",
            "surface",
            "refinement",
            "views",
            "images",
            "capture",
            "timings",
            "outputs",
        ] {
            assert!(page.contains(&format!("id=\"{id}\"")), "{id}");
        }
        assert!(
            page.contains("vase &lt;3&gt;")
                && page.contains("12\u{202f}345")
                && page.contains("−50 %")
        );
        // A field is a picture and its bar.
        assert_eq!(page.matches("<img").count(), 10);
        assert!(
            page.contains("of the worst known tilt") && page.contains("10.00 % of its vertices")
        );
        assert!(page.contains("lay within 1.23 mm of the base mesh"));
        assert_eq!(page.matches("<svg").count(), 2);
        assert_self_contained(&page);
    }

    #[test]
    fn a_scan_that_was_not_refined_says_why() {
        let report = Report {
            not_refined_reason: Some("no shading image was taken".into()),
            ..report()
        };
        let page = written(&report, &ReportPictures::default());
        assert!(
            page.contains("id=\"not-refined\"") && page.contains("No shading image was taken.")
        );
        assert!(!page.contains("id=\"refinement\""));
        assert_self_contained(&page);
    }

    #[test]
    fn frames_that_were_taken_back_are_told_of() {
        let said = |in_model| {
            let report = Report {
                frames: FrameCounts {
                    total: 148,
                    fused: 109,
                    in_model,
                    ..FrameCounts::default()
                },
                ..report()
            };
            written(&report, &ReportPictures::default())
        };
        assert!(said(23).contains("109 of 148 frames fused, 23 of them in the model: a surface"));
        assert!(said(109).contains("109 of 148 frames fused: a surface"));
    }
}
