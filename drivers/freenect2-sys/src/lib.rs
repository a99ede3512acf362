//! The C shim over libfreenect2, as bindgen sees its header `shim/freenect2_shim.h`.
//!
//! Who owns what, and which thread may call, is written in that header. The functions come as a table, [`f2shim_api`]:
//! with the feature `kinect2` `libfreenect2()` has the one over the library; without it this crate is types alone and
//! needs no native library.

// As bindgen writes them: the test compares them byte for byte.
#[rustfmt::skip]
mod bindings;

pub use bindings::*;

/// The table over the library that this program was linked with.
#[cfg(feature = "kinect2")]
pub fn libfreenect2() -> &'static f2shim_api {
    // SAFETY: the shim's function has no precondition, and its table is constant and never freed.
    unsafe { &*f2shim_libfreenect2() }
}
