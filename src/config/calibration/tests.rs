//! Which of several calibrations is found.

use super::*;
use depth_camera::DepthCamera;
use simulated::SimulatedCamera;

const COMPLETE: &str = include_str!("../../../config/calibration-kinect2.toml");

/// A folder of calibrations and a session beside it.
struct Bench {
    root: tempfile::TempDir,
    info: CameraInfo,
}

impl Bench {
    fn new() -> Self {
        let root = tempfile::tempdir().unwrap();
        for name in ["calibration", "session"] {
            fs::create_dir(root.path().join(name)).unwrap();
        }
        let info = SimulatedCamera::kinect2_plaque(1, 5).info().clone();
        Bench { root, info }
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.root.path().join(name);
        fs::write(&path, text).unwrap();
        path
    }

    fn find(&self, given: Option<&Path>) -> Result<FoundCalibration, ConfigError> {
        let places = CalibrationPlaces {
            given,
            folder: &self.root.path().join("calibration"),
            session: Some(&self.root.path().join("session")),
        };
        find_calibration(&self.info, &places)
    }
}

fn complete(gamma: f64) -> String {
    COMPLETE.replace("gamma = 0.87", &format!("gamma = {gamma}"))
}

fn partial(serial: &str, sensor: &str) -> String {
    format!("version = 1\nserial = \"{serial}\"\nsensor = \"{sensor}\"\ngamma = 0.9\n")
}

#[test]
fn the_most_binding_place_wins() {
    let bench = Bench::new();
    let found = bench.find(None).unwrap();
    assert_eq!(
        found.source,
        CalibrationSource::Shipped(Sensor::Kinect2, None)
    );
    for (name, gamma) in [
        ("session/calibration.toml", 1.1),
        ("calibration/simulated-5.toml", 1.2),
    ] {
        let path = bench.write(name, &complete(gamma));
        let found = bench.find(None).unwrap();
        assert_eq!(found.calibration.gamma, gamma);
        assert_eq!(found.source, CalibrationSource::File(path));
        assert_eq!(found.warnings(&bench.info), Vec::<String>::new());
    }
    let given = bench.write("mine.toml", &complete(1.3));
    assert_eq!(bench.find(Some(&given)).unwrap().calibration.gamma, 1.3);
}

#[test]
fn a_recording_in_one_file_has_its_calibration_beside_it() {
    let bench = Bench::new();
    let beside = bench.write("session/calibration.toml", &complete(1.1));
    let places = CalibrationPlaces {
        given: None,
        folder: &bench.root.path().join("calibration"),
        session: Some(&bench.write("session/segment-0000.mcap", "")),
    };
    let found = find_calibration(&bench.info, &places).unwrap();
    assert_eq!(found.source, CalibrationSource::File(beside));
}

#[test]
fn a_serial_that_is_no_file_name_has_no_file() {
    let mut bench = Bench::new();
    bench.write("calibration/simulated-5.toml", &complete(0.9));
    for stranger in ["simulated-6", "../calibration/simulated-5", ""] {
        bench.info.serial = stranger.to_owned();
        let source = bench.find(None).unwrap().source;
        assert_eq!(source, CalibrationSource::Shipped(Sensor::Kinect2, None));
    }
}

#[test]
fn keys_that_a_device_lacks_are_shipped_and_told_of_once() {
    let bench = Bench::new();
    let path = bench.write(
        "calibration/simulated-5.toml",
        &partial("simulated-5", "kinect2"),
    );
    let found = bench.find(None).unwrap();
    assert_eq!(found.calibration.gamma, 0.9);
    assert_eq!(
        found.warnings(&bench.info),
        [format!(
            "{} does not have flat_field, light.lobe_power, noise: what is shipped for every kinect2 is used",
            path.display()
        )]
    );
}

#[test]
fn the_file_of_another_device_is_refused_unless_it_was_asked_for() {
    let bench = Bench::new();
    let path = bench.write(
        "calibration/simulated-5.toml",
        &partial("simulated-6", "kinect2"),
    );
    let error = bench.find(None).unwrap_err();
    assert_eq!(
        error.what,
        "serial is \"simulated-6\", must be \"simulated-5\""
    );
    let warnings = bench.find(Some(&path)).unwrap().warnings(&bench.info);
    assert!(warnings[0].contains("of the device simulated-6, this one is simulated-5"));
    let other = bench.write("other.toml", &partial("simulated-5", "kinect1"));
    let error = bench.find(Some(&other)).unwrap_err();
    assert_eq!(error.what, "sensor is \"kinect1\", must be \"kinect2\"");
}

#[test]
fn what_a_fused_scan_no_longer_takes_is_told() {
    let bench = Bench::new();
    let late = |keys: &str, gamma: f64| {
        let text = complete(gamma);
        let path = bench.write("given.toml", &format!("{keys}\n{text}"));
        let found = bench.find(Some(&path)).unwrap();
        found.comes_too_late(&Calibration::from_toml(COMPLETE).unwrap())
    };
    assert_eq!(late("", 0.7), None);
    let same_pixels = late("ir_offset_px = [0.4, -0.3]", 0.87);
    assert_eq!(same_pixels, None);
    let offset = "ir_offset_px = [5.0, 4.0]";
    let said = late(offset, 0.87).unwrap();
    assert!(
        said.contains("given.toml has another ir_offset_px than"),
        "{said}"
    );
    let range = "range_error_m = [[0.5, 0.001], [1.0, 0.002]]";
    let said = late(&format!("{offset}\n{range}"), 0.87).unwrap();
    assert!(
        said.contains("another ir_offset_px and another range_error_m than"),
        "{said}"
    );
}
