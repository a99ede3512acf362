//! libfreenect's C functions, types and constants, as far as the driver of the Kinect I uses them.
//!
//! `bindings.rs` is made by bindgen from the headers of Debian's `libfreenect-dev` (library version 0.5.3) and checked in,
//! so that no build needs libclang; its `const` blocks assert the layout of every structure. The test `regenerate`
//! (feature of that name) makes it anew and compares. C enumerations are plain integers: some are sets of bits, and the library is
//! free to return a value that the header does not list. Layouts are those of 64-bit Linux.
//!
//! Nothing is linked without the feature `kinect1`. With it, `FREENECT_LIB_DIR` may name the folder of a library that the
//! linker does not find by itself.

#![no_std]
#![allow(
    missing_docs,
    non_camel_case_types,
    non_upper_case_globals,
    reason = "names and documentation are those of the C headers"
)]

include!("bindings.rs");
