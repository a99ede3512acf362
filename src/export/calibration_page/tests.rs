//! Tests of the whole page on invented calibrations.

use super::super::page::assert_self_contained;
use super::*;

const SECTIONS: [&str; 6] = [
    "remarks",
    "results",
    "response",
    "distance",
    "flat-field",
    "recordings",
];

fn written(page: &CalibrationPage) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("calibration.html");
    write_calibration_page(&path, page).unwrap();
    std::fs::read_to_string(&path).unwrap()
}

fn response_figure() -> ResponseFigure {
    let gamma = 0.87;
    let scatter = (1..200).map(|k| {
        let linear = f64::from(k) / 220.0;
        let predicted = linear.powf(gamma);
        [
            linear,
            predicted,
            predicted * (1.0 + 0.01 * f64::from(k).sin()),
        ]
    });
    let mut residual_map = Image::filled(20, 16, f32::NAN);
    for v in 4..9 {
        for u in 6..13 {
            residual_map.data_mut()[v * 20 + u] = 0.002 * (u as f32 - 9.0);
        }
    }
    ResponseFigure {
        gamma,
        scatter: scatter.collect(),
        within: 0.987,
        inlier_bound: 0.05,
        residuals: vec![vec![Some(0.004), Some(-0.012)], vec![None, Some(f64::NAN)]],
        shares: vec![0.0, 0.05, 1.0],
        incidences: vec![0.25, 0.65, 1.0],
        residual_map,
    }
}

fn full() -> CalibrationPage {
    let fall = |distance_m: f64| [distance_m, distance_m.powf(-1.98)];
    let mut regions = [[Some((-1.98, 0.01)); 3]; 3];
    regions[2][0] = None;
    CalibrationPage {
        serial: "<0123>".into(),
        sensor: "kinect2".into(),
        date: "2024-05-01".into(),
        command: "response".into(),
        sessions: vec![CalibrationSession {
            name: "ball & stand".into(),
            target: "sphere, radius 120.5 ± 0.3 mm".into(),
            n_images: 24,
            ..CalibrationSession::default()
        }],
        results: vec![CalibrationResult {
            name: "Response γ".into(),
            value: "0.870 ± 0.004".into(),
            remark: "by <i>RANSAC</i>".into(),
        }],
        remarks: vec!["the albedo cannot be told from the light's strength".into()],
        response: Some(response_figure()),
        distance: Some(DistanceFigure {
            curve: [0.6, 0.9, 1.4, 2.1, 3.2].map(fall).to_vec(),
            exponent: (-1.98, 0.004),
            regions,
        }),
        flat_field: Some(FlatFieldFigure {
            factor: Image::from_vec(3, 2, vec![0.6, 1.0, 0.6, 0.61, f32::NAN, 0.59]),
            sigma: Image::filled(3, 2, 0.004),
            corner: (0.6, 0.01),
            sigma_rms: 0.004,
        }),
    }
}

#[test]
fn a_full_calibration_has_all_sections_and_nothing_from_outside() {
    let page = written(&full());
    for id in SECTIONS {
        assert!(page.contains(&format!("id=\"{id}\"")), "{id}");
    }
    // Two plots of the response and two of distance; a map and two fields, each with its colour bar.
    assert_eq!(page.matches("<svg").count(), 4);
    assert_eq!(page.matches("<img").count(), 6);
    assert!(page.contains("Kinect II · &lt;0123&gt;") && page.contains("ball &amp; stand"));
    assert!(page.contains("by &lt;i&gt;RANSAC"));
    assert!(page.contains("γ = 0.870") && page.contains("−1.980 ± 0.004"));
    assert!(page.contains("Columns 6 to 12, rows 4 to 8"));
    assert!(page.contains("+0.40") && page.contains("−1.20"));
    assert_self_contained(&page);
}

#[test]
fn what_was_not_measured_has_no_section() {
    let page = written(&CalibrationPage::default());
    for id in SECTIONS {
        assert!(!page.contains(&format!("id=\"{id}\"")), "{id}");
    }
    assert!(page.contains(
        "Not measured: the response, the fall of light with distance and the flat field."
    ));
    assert_self_contained(&page);
}

#[test]
fn numbers_that_are_not_there_are_dashes_or_left_out() {
    let (nan, nowhere) = (f64::NAN, Image::filled(4, 3, f32::NAN));
    let none = Image::from_vec(0, 0, vec![]);
    for (residual_map, factor) in [(nowhere.clone(), none.clone()), (none, nowhere)] {
        let page = CalibrationPage {
            response: Some(ResponseFigure {
                gamma: nan,
                scatter: vec![[nan, 0.5, 0.5], [f64::INFINITY, nan, 0.1]],
                within: nan,
                inlier_bound: nan,
                residual_map,
                ..response_figure()
            }),
            distance: Some(DistanceFigure {
                curve: vec![[1.0, nan], [0.0, 1.0], [-1.0, 1.0]],
                exponent: (nan, nan),
                regions: [[Some((nan, 0.1)); 3]; 3],
            }),
            flat_field: Some(FlatFieldFigure {
                sigma: factor.clone(),
                factor,
                corner: (nan, nan),
                sigma_rms: nan,
            }),
            ..full()
        };
        let text = written(&page);
        assert!(!text.contains("NaN") && !text.contains("inf"));
        assert!(text.matches("There is nothing to draw").count() == 5);
    }
}

#[test]
fn a_few_points_and_unknown_bounds_still_make_plots() {
    let mut page = full();
    if let Some(response) = &mut page.response {
        response.gamma = f64::NAN;
        response.inlier_bound = f64::NAN;
        response.scatter.push([f64::NAN; 3]);
    }
    if let Some(distance) = &mut page.distance {
        distance.curve.truncate(1);
        distance.exponent.0 = f64::NAN;
    }
    let text = written(&page);
    assert!(!text.contains("NaN") && !text.contains("inf"));
    assert!(text.contains("1 of 200 points lie outside the axes"));
}
