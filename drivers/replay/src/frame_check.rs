//! Which frames belong into a recording.

use depth_camera::{CameraInfo, Frame, Image};

/// Whether a frame holds an image, all of the size that the camera promises, and no IR that the camera was not said to have.
///
/// # Errors
/// Says what is wrong, with the value and what it must be.
pub fn check_frame(frame: &Frame, info: &CameraInfo) -> Result<(), String> {
    let i = &info.intrinsics;
    let sizes = [
        ("depth", frame.depth.as_ref().map(size)),
        ("IR", frame.ir.as_ref().map(size)),
    ];
    for (what, size) in sizes {
        let Some((width, height)) = size else {
            continue;
        };
        if (width, height) != (i.width, i.height) {
            return Err(format!(
                "{what} is {width}×{height}, must be {}×{}",
                i.width, i.height
            ));
        }
    }
    if frame.depth.is_none() && frame.ir.is_none() {
        return Err("it holds no image".to_owned());
    }
    if frame.ir.is_some() && !info.has_infrared() {
        return Err("it holds IR, but the camera has neither scale nor light".to_owned());
    }
    if !frame.device_time_secs.is_finite() {
        return Err(format!(
            "its time is {} s, must be finite",
            frame.device_time_secs
        ));
    }
    Ok(())
}

fn size<T>(image: &Image<T>) -> (usize, usize) {
    (image.width(), image.height())
}
