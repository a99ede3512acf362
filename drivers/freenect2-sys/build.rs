//! Compiles the shim over libfreenect2 where the feature asks for it; nothing otherwise.

fn main() {
    println!("cargo::rerun-if-changed=shim");
    #[cfg(feature = "kinect2")]
    compile_shim();
}

#[cfg(feature = "kinect2")]
fn compile_shim() {
    let library = match pkg_config::Config::new()
        .atleast_version("0.2")
        .probe("freenect2")
    {
        Ok(library) => library,
        Err(error) => {
            eprintln!("feature kinect2 needs libfreenect2, see docs/devices.md: {error}");
            std::process::exit(1);
        }
    };
    cc::Build::new()
        .cpp(true)
        .std("c++11")
        .warnings_into_errors(true)
        .includes(&library.include_paths)
        .file("shim/freenect2_shim.cpp")
        .compile("freenect2_shim");
}
