use super::*;
use simulated::SimulatedCamera;
use std::time::Instant;

const FULL_SCALE: f64 = 1023.0;

/// What a scripted camera shows with depth stopped.
#[derive(Clone, Copy)]
enum Light {
    Projector,
    Nothing,
    Lamp,
}

/// A camera that obeys; its lights are those of the frames after depth was stopped, the last one for ever.
struct Scripted {
    info: CameraInfo,
    lights: Vec<Light>,
    n_paused: Option<usize>,
    n_frames: u64,
    can_pause: bool,
    unplugged_at: Option<usize>,
}

impl Scripted {
    fn new(lights: &[Light]) -> Self {
        Scripted {
            info: SimulatedCamera::kinect1_plaque(1, 0).info().clone(),
            lights: lights.to_vec(),
            n_paused: None,
            n_frames: 0,
            can_pause: true,
            unplugged_at: None,
        }
    }

    fn asked(self) -> (StopDepthCamera, ShadingRequest) {
        let request = ShadingRequest::default();
        let camera = StopDepthCamera::new(Box::new(self), request.clone(), 4);
        let camera = camera.unwrap_or_else(|_| panic!("it delivers IR"));
        request.ask();
        (camera, request)
    }
}

fn image(light: Light) -> Image<u16> {
    let value = |u: usize, v: usize| match light {
        Light::Projector if u.is_multiple_of(4) && v.is_multiple_of(4) => 800,
        Light::Projector => 10,
        Light::Nothing => ((u * 5 + v * 3) % 7) as u16,
        Light::Lamp => (200 + 5 * u + 3 * v) as u16,
    };
    let pixels = (0..64 * 48).map(|i| value(i % 64, i / 64));
    Image::from_vec(64, 48, pixels.collect())
}

impl DepthCamera for Scripted {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn grab(&mut self, _timeout: Duration) -> Result<Option<Frame>, CameraError> {
        self.n_frames += 1;
        let light = match &mut self.n_paused {
            None => Light::Projector,
            Some(n) => {
                *n += 1;
                if self.unplugged_at == Some(*n) {
                    return Err(CameraError::Disconnected);
                }
                self.lights[(*n - 1).min(self.lights.len() - 1)]
            }
        };
        Ok(Some(Frame {
            frame_id: self.n_frames,
            device_time_secs: self.n_frames as f64 / 30.0,
            host_time: Instant::now(),
            depth: self.n_paused.is_none().then(|| Image::filled(64, 48, 1.0)),
            ir: Some(image(light)),
        }))
    }

    fn pause_depth(&mut self) -> Result<(), CameraError> {
        if !self.can_pause {
            return Err(CameraError::Invalid("it cannot".to_owned()));
        }
        self.n_paused = Some(0);
        Ok(())
    }

    fn resume_depth(&mut self) -> Result<(), CameraError> {
        self.n_paused = None;
        Ok(())
    }
}

/// Grabs until the request is answered; how many frames came without depth, and how it ended.
fn run(camera: Scripted) -> (usize, ShadingOutcome) {
    let (mut camera, request) = camera.asked();
    let mut n_without_depth = 0;
    for _ in 0..1000 {
        if let Ok(frame) = camera.grab(Duration::ZERO) {
            n_without_depth += usize::from(frame.unwrap().depth.is_none());
        }
        if let Some(outcome) = request.take_outcome() {
            let next = camera.grab(Duration::ZERO).unwrap().unwrap();
            assert!(next.depth.is_some(), "depth is back");
            return (n_without_depth, outcome);
        }
    }
    panic!("no outcome");
}

/// So many frames at 30 Hz take so long, but for the rounding of the time between them.
fn assert_about(n_frames: usize, secs: f64) {
    let n_expected = (30.0 * secs) as usize + 1;
    assert!(
        (n_expected..=n_expected + 1).contains(&n_frames),
        "{n_frames}"
    );
}

#[test]
fn four_exposures_under_the_lamp_end_it_when_the_projector_is_dark() {
    let lights = [
        Light::Projector,
        Light::Nothing,
        Light::Nothing,
        Light::Lamp,
    ];
    let (n_frames, outcome) = run(Scripted::new(&lights));
    assert_eq!(outcome, ShadingOutcome::Taken { n_exposures: 4 });
    assert_eq!(n_frames, 7);
}

#[test]
fn a_projector_that_stays_lit_is_refused_with_its_energy() {
    let (n_frames, outcome) = run(Scripted::new(&[Light::Projector]));
    let ShadingOutcome::Refused(refusal) = outcome else {
        panic!("{outcome:?}");
    };
    let energy = texture(&image(Light::Projector), FULL_SCALE).speckle_energy;
    assert_eq!(refusal, ShadingRefusal::Speckle { energy });
    let says = refusal.to_string();
    assert!(says.contains("must be below 0.12"), "{says}");
    assert!(says.contains("capture.shading to \"shutter\""), "{says}");
    assert_about(n_frames, MAX_SPECKLED_SECS);
}

#[test]
fn a_lamp_that_is_never_lit_is_refused() {
    let (n_frames, outcome) = run(Scripted::new(&[Light::Nothing]));
    assert_eq!(outcome, ShadingOutcome::Refused(ShadingRefusal::Dark));
    assert_about(n_frames, MAX_DARK_SECS);
}

#[test]
fn a_camera_that_cannot_or_is_unplugged_is_refused() {
    let camera = Scripted {
        can_pause: false,
        ..Scripted::new(&[Light::Lamp])
    };
    let (n_frames, outcome) = run(camera);
    assert_eq!(n_frames, 0);
    let ShadingOutcome::Refused(refusal) = outcome else {
        panic!("{outcome:?}");
    };
    assert_eq!(refusal.to_string(), "depth cannot be stopped: it cannot");
    let camera = Scripted {
        unplugged_at: Some(3),
        ..Scripted::new(&[Light::Lamp])
    };
    let unplugged = ShadingRefusal::Camera(CameraError::Disconnected);
    assert_eq!(run(camera).1, ShadingOutcome::Refused(unplugged));
}

#[test]
fn without_a_request_nothing_is_stopped() {
    let request = ShadingRequest::default();
    let camera = StopDepthCamera::new(Box::new(Scripted::new(&[Light::Lamp])), request, 4);
    let mut camera = camera.unwrap_or_else(|_| panic!("it delivers IR"));
    for _ in 0..10 {
        let frame = camera.grab(Duration::ZERO).unwrap().unwrap();
        assert!(frame.depth.is_some());
    }
}
