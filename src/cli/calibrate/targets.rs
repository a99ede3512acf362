//! `relief calibrate response|flat-field|light`: gather the sessions, fit Eq. (1) to all of them, say what was found, and
//! write what the command is for into the device's file.

use super::{
    TargetArgs, check_beforehand,
    findings::Findings,
    measured_session, merge, next_frame, of_fitting, open,
    page::write_page,
    print::{print_json, print_text},
};
use crate::cli::{
    run::{Verdict, calibration_folder, require_folder, session_name},
    stopping::check_wanted,
    summary::with_causes,
};
use anyhow::{Context, bail, ensure};
use depth_camera::CameraInfo;
use nalgebra::Point3;
use relief::{
    calibrate::{
        BallRadius, Estimate, Gatherer, InverseSquare, Priors, Scan, Sensor, Target, estimate,
        inverse_square, response_check,
    },
    capture::IrOffset,
    config::{
        self, CalibrationKey, CalibrationPlaces, Config, DeviceCalibration, FoundCalibration,
        Measurement, Overrides, calibration_path,
    },
    depth_correction::DepthCorrection,
    fusion::FusionParams,
    geometry::{CameraModel, RayGrid},
    shading::FlatField,
};
use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
    time::SystemTime,
};

/// What a command is to find.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Aim {
    /// The exponent of the response.
    Response,
    /// The lens's flat field and the light's lobe.
    FlatField,
    /// The light's place.
    Light,
}

impl Aim {
    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Aim::Response => "response",
            Aim::FlatField => "flat-field",
            Aim::Light => "light",
        }
    }

    /// What the command is for; the light's lobe comes with its place where it is not measured yet.
    fn keys(self) -> &'static [CalibrationKey] {
        match self {
            Aim::Response => &[CalibrationKey::Gamma],
            Aim::FlatField => &[CalibrationKey::FlatField, CalibrationKey::LightLobePower],
            Aim::Light => &[CalibrationKey::LightPosition],
        }
    }

    /// How well the light's place is believed beforehand, metres: as stated by a maker, or as measured by eye.
    fn light_sigma_m(self) -> f64 {
        match self {
            Aim::Response | Aim::FlatField => 0.003,
            Aim::Light => 0.025,
        }
    }
}

/// How well the power of a lobe is believed beforehand: emitters lie between even and cos³.
const LOBE_SIGMA: f64 = 1.5;

/// The device that all sessions are of.
struct Device {
    info: CameraInfo,
    serial: String,
    /// Where what is measured of it goes.
    file: PathBuf,
    /// The calibration that it has so far.
    found: FoundCalibration,
}

/// Runs a command.
pub fn calibrate(aim: Aim, args: &TargetArgs, stop: &AtomicBool) -> anyhow::Result<Verdict> {
    let config = Config::layered(None, &Overrides::default())?;
    let device = device(args, &config)?;
    let of_page = args.page.as_deref().and_then(Path::parent);
    // A bare name is of the working directory, and the calibration's own folder is made for it.
    let is_made = |folder: &Path| !args.file.dry_run && device.file.parent() == Some(folder);
    let of_page = of_page.filter(|folder| *folder != Path::new("") && !is_made(folder));
    if let Some(of_page) = of_page {
        require_folder("--page", of_page)?;
    }
    if !args.file.dry_run {
        let nothing = DeviceCalibration::new(device.serial.clone(), device.info.sensor);
        check_beforehand(&device.file, &nothing, aim.keys(), args.file.replace)?;
    }
    let found = &device.found;
    let scans = gather(args, &config, &device, stop)?;
    require_targets(aim, args, &scans)?;

    let rays = RayGrid::new(CameraModel::new(device.info.intrinsics));
    let sensor = Sensor {
        kind: device.info.sensor,
        rays: &rays,
        full_scale: device
            .info
            .ir_full_scale
            .context("the session has no infrared images")?,
        noise: found.calibration.noise,
    };
    let priors = priors(aim, args, &device.info, found)?;
    let findings = investigate(aim, scans, &sensor, priors, found, stop)?;
    check_wanted(stop)?;
    // What cannot be printed is written all the same, and what cannot be written is printed.
    let written = write_all(&findings, &sensor, &device, args);
    if args.json {
        let failure = written.as_ref().err().map(with_causes);
        let printed = print_json(&findings, failure.as_slice());
        if let Err(error) = &written {
            // The object tells of it, and no other follows.
            tracing::error!("{}", with_causes(error));
            return Ok(Verdict::of_error(error));
        }
        return printed.map(|()| Verdict::Done);
    }
    let printed = print_text(&findings);
    written?;
    printed?;
    Ok(Verdict::Done)
}

/// The device that the first session is of.
fn device(args: &TargetArgs, config: &Config) -> anyhow::Result<Device> {
    let folder = calibration_folder(args.file.calibration_dir.as_deref(), None);
    let first = args.sessions.first().context("no session is given")?;
    let info = open(first, config)?.info().clone();
    let serial = args.file.serial.as_ref().unwrap_or(&info.serial).clone();
    let found = find(&info, &serial, args, &folder)?;
    Ok(Device {
        file: calibration_path(&folder, &serial)?,
        info,
        serial,
        found,
    })
}

/// Replays every session; all must be of one device.
fn gather(
    args: &TargetArgs,
    config: &Config,
    device: &Device,
    stop: &AtomicBool,
) -> anyhow::Result<Vec<Scan>> {
    let ir_offset = IrOffset::nearest(device.found.calibration.ir_offset_px);
    let radius = args
        .radius
        .map_or(BallRadius::Unknown, |radius| BallRadius::Given(radius.0));
    let mut scans = Vec::new();
    for (session, name) in args.sessions.iter().zip(distinct_names(&args.sessions)) {
        let mut camera = open(session, config)?;
        check_same_device(
            &device.info,
            camera.info(),
            session,
            args.file.serial.is_some(),
        )?;
        let mut gatherer = Gatherer::new(camera.info(), FusionParams::default())
            .with_context(|| format!("{}: no infrared images with a light", session.display()))?;
        let calibration = &device.found.calibration;
        let mut known = DepthCorrection::new(camera.info(), calibration, false, &config.fusion);
        while let Some(frame) = next_frame(camera.as_mut(), stop)? {
            let frame = ir_offset.remove_from(frame);
            gatherer.observe(&known.correct(&frame).unwrap_or(frame));
        }
        let scan = gatherer.finish(&name, radius)?;
        tracing::info!(session = scan.name, images = scan.images.len(), shares = %scan.shares, "gathered");
        scans.push(scan);
    }
    Ok(scans)
}

/// Names of sessions by which they can be told apart: one that was there before gets a number.
fn distinct_names(sessions: &[PathBuf]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for session in sessions {
        let name = session_name(session);
        let numbered = (2..).map(|number| format!("{name}-{number}"));
        let free = std::iter::once(name.clone())
            .chain(numbered)
            .find(|name| !names.contains(name))
            .expect("numbers do not end before sessions do");
        names.push(free);
    }
    names
}

fn check_same_device(
    first: &CameraInfo,
    info: &CameraInfo,
    session: &Path,
    serial_is_given: bool,
) -> anyhow::Result<()> {
    ensure!(
        info.sensor == first.sensor && info.intrinsics == first.intrinsics,
        "{}: another camera than that of the first session",
        session.display()
    );
    ensure!(
        info.ir_full_scale == first.ir_full_scale && info.light == first.light,
        "{}: another infrared scale or light than that of the first session",
        session.display()
    );
    ensure!(
        serial_is_given || info.serial == first.serial,
        "{}: of device {}, the first session is of device {}; if they are one device, say which with --serial",
        session.display(),
        info.serial,
        first.serial
    );
    Ok(())
}

fn find(
    info: &CameraInfo,
    serial: &str,
    args: &TargetArgs,
    folder: &Path,
) -> anyhow::Result<FoundCalibration> {
    let info = CameraInfo {
        serial: serial.to_owned(),
        ..info.clone()
    };
    let places = CalibrationPlaces {
        given: args.calibration.as_deref(),
        folder,
        session: args.sessions.first().map(PathBuf::as_path),
    };
    Ok(config::find_calibration(&info, &places)?)
}

/// What a command cannot do without.
fn require_targets(aim: Aim, args: &TargetArgs, scans: &[Scan]) -> anyhow::Result<()> {
    let has_wall = scans.iter().any(|scan| scan.target == Target::Wall);
    let has_sphere = scans.iter().any(|scan| scan.target != Target::Wall);
    let what_for = match (aim, args.radius) {
        (Aim::Response, _) => Some("from which the response is measured"),
        (_, Some(_)) => Some("whose radius is given"),
        (Aim::FlatField | Aim::Light, None) => None,
    };
    match what_for {
        Some(what_for) if !has_sphere => bail!(
            "no session shows a sphere, {what_for}; the sessions show walls only ({})",
            told_shares(scans)
        ),
        _ if aim == Aim::FlatField && !has_wall => bail!(
            "no session shows a plain wall, from which the flat field is measured; the sessions show spheres only ({})",
            told_shares(scans)
        ),
        _ => Ok(()),
    }
}

/// Why each session was taken for what it was taken for.
fn told_shares(scans: &[Scan]) -> String {
    let shares = scans
        .iter()
        .map(|Scan { name, shares, .. }| format!("{name}: {shares}"));
    shares.collect::<Vec<_>>().join("; ")
}

fn priors(
    aim: Aim,
    args: &TargetArgs,
    info: &CameraInfo,
    found: &FoundCalibration,
) -> anyhow::Result<Priors> {
    let stated = info.light.context("the session states no light")?;
    let mut light = found.calibration.light.near_light(stated.position_m);
    if let Some(start) = args.start {
        light.position = Point3::from(start.0);
    }
    Ok(Priors {
        light,
        light_sigma_m: aim.light_sigma_m(),
        lobe_sigma: LOBE_SIGMA,
        flat_field: found.calibration.flat_field.clone(),
    })
}

/// Fits everything, then looks at what the command is for, unless somebody asks to stop.
fn investigate(
    aim: Aim,
    mut scans: Vec<Scan>,
    sensor: &Sensor,
    priors: Priors,
    found: &FoundCalibration,
    stop: &AtomicBool,
) -> anyhow::Result<Findings> {
    let fit = |scans: &mut [Scan], priors: &Priors| {
        estimate(scans, sensor, priors, &|| check_wanted(stop).is_ok()).map_err(of_fitting)
    };
    let whole = fit(&mut scans, &priors)?;
    let mut spheres: Vec<Scan> = scans
        .iter()
        .filter(|scan| scan.target != Target::Wall)
        .cloned()
        .collect();
    // What the spheres say of the response by themselves tests the inverse square law, which the whole fit takes for
    // granted; light and lens are those of the whole fit, since a sphere at one distance does not know them.
    let spheres_alone: Option<Estimate> = match spheres.len() {
        0 => None,
        n if n == scans.len() => None,
        _ => Some(fit(&mut spheres, &fitted_priors(&whole))?),
    };
    let mut responses = Vec::new();
    let mut distances: Vec<(usize, InverseSquare)> = Vec::new();
    for (index, scan) in scans.iter().enumerate() {
        check_wanted(stop)?;
        match scan.target {
            Target::Wall => match inverse_square(&scans, index, sensor, &whole) {
                Ok(law) => distances.push((index, law)),
                Err(refusal) if aim == Aim::FlatField => return Err(refusal.into()),
                Err(refusal) => tracing::warn!(%refusal, "inverse square law not checked"),
            },
            Target::Sphere(_) => {
                responses.push((index, response_check(&scans, index, sensor, &whole)?));
            }
        }
    }
    Ok(Findings {
        aim,
        scans,
        estimate: whole,
        spheres_alone,
        responses,
        distances,
        priors,
        known_gamma: found.calibration.gamma,
        gamma_origin: found.origins[&CalibrationKey::Gamma].to_string(),
    })
}

/// The light and lens of a fit as what is believed beforehand.
fn fitted_priors(fitted: &Estimate) -> Priors {
    let largest = |sigmas: [f64; 3]| sigmas.into_iter().fold(0.0, f64::max);
    Priors {
        light: fitted.state.light,
        light_sigma_m: largest(fitted.light_position().map(|axis| axis.sigma)).max(1e-4),
        lobe_sigma: fitted.lobe_power().sigma.max(1e-3),
        flat_field: FlatField::Spline(fitted.state.flat.clone()),
    }
}

/// Writes the device's file and the page, as far as they are asked for.
fn write_all(
    findings: &Findings,
    sensor: &Sensor,
    of: &Device,
    args: &TargetArgs,
) -> anyhow::Result<()> {
    if !args.file.dry_run {
        let report = write(findings, of, args)?;
        if let Some(kept) = &report.kept {
            tracing::info!(kept = %kept.display(), "the file as it was is kept");
        }
        tracing::info!(path = %of.file.display(), "calibration written");
    }
    let page = match &args.page {
        Some(page) => page.clone(),
        None if args.file.dry_run => return Ok(()),
        None => {
            let name = format!("{}.{}.html", of.serial, findings.aim.name());
            of.file.with_file_name(name)
        }
    };
    write_page(&page, findings, &of.serial, sensor)?;
    tracing::info!(page = %page.display(), "page written");
    Ok(())
}

/// Merges what the command is for into the device's file.
fn write(
    findings: &Findings,
    of: &Device,
    args: &TargetArgs,
) -> anyhow::Result<config::MergeReport> {
    let measured_sessions = args
        .sessions
        .iter()
        .zip(&findings.scans)
        .map(|(session, scan)| measured_session(scan.name.clone(), session))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut device = DeviceCalibration::new(of.serial.clone(), of.info.sensor);
    let state = &findings.estimate.state;
    let mut keys = findings.aim.keys().to_vec();
    match findings.aim {
        Aim::Response => device.gamma = Some(state.gamma),
        Aim::FlatField => {
            device.flat_field = Some(FlatField::Spline(state.flat.clone()));
            device.light.lobe_power = Some(state.light.lobe_power);
        }
        Aim::Light => {
            device.light.position_m = Some(findings.believed_position().into());
            // Place and lobe were fitted together; a lobe that was measured with the flat field belongs to that.
            if !has_lobe(&of.file)? {
                device.light.lobe_power = Some(state.light.lobe_power);
                keys.push(CalibrationKey::LightLobePower);
            }
        }
    }
    let time = SystemTime::now();
    for key in keys {
        let figures: BTreeMap<String, f64> = findings.figures(key);
        let measurement = Measurement::new(time, measured_sessions.clone(), figures);
        device.measured.insert(key, measurement);
    }
    merge(&of.file, &device, &of.info, args.file.replace)
}

/// Whether the light's lobe is in a device's own file; one that is not there has none. A complete calibration has a lobe always, as that
/// beside a recording, and says nothing of whether it was measured.
fn has_lobe(file: &Path) -> anyhow::Result<bool> {
    let device = DeviceCalibration::read_if_there(file)?;
    Ok(device.is_some_and(|device| device.holds(CalibrationKey::LightLobePower)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lobe_is_measured_where_the_device_s_own_file_holds_it() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("simulated-1.toml");
        assert!(!has_lobe(&file).unwrap());
        let device = "version = 1\nserial = \"simulated-1\"\nsensor = \"kinect2\"\n";
        std::fs::write(&file, device).unwrap();
        assert!(!has_lobe(&file).unwrap());
        std::fs::write(&file, format!("{device}[light]\nlobe_power = 1.2\n")).unwrap();
        assert!(has_lobe(&file).unwrap());
    }

    #[test]
    fn sessions_of_one_name_can_be_told_apart() {
        let sessions = ["a/recording", "b/recording", "b/wall", "c/wall", "a"];
        let names = distinct_names(&sessions.map(PathBuf::from));
        assert_eq!(names, ["recording", "recording-2", "wall", "wall-2", "a"]);
    }
}
