//! Links to libfreenect where the feature `kinect1` asks for it.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=FREENECT_LIB_DIR");
    if std::env::var_os("CARGO_FEATURE_KINECT1").is_none() {
        return;
    }
    // For a library that lies where the linker does not look by itself.
    if let Ok(folder) = std::env::var("FREENECT_LIB_DIR") {
        println!("cargo::rustc-link-search=native={folder}");
    }
    println!("cargo::rustc-link-lib=dylib=freenect");
}
