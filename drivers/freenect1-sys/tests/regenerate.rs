//! The checked-in bindings are what bindgen makes of the installed headers.

use std::path::Path;

const HEADERS: &str = "#include <libfreenect.h>\n#include <libfreenect_registration.h>\n";

/// What the driver calls; everything else of the library stays out.
const FUNCTIONS: &[&str] = &[
    "init",
    "shutdown",
    "set_log_level",
    "set_log_callback",
    "process_events_timeout",
    "num_devices",
    "list_device_attributes",
    "free_device_attributes",
    "select_subdevices",
    "open_device_by_camera_serial",
    "close_device",
    "set_user",
    "get_user",
    "set_(depth|video)_callback",
    "set_(depth|video)_chunk_callback",
    "set_(depth|video)_buffer",
    "set_(depth|video)_mode",
    "find_(depth|video)_mode",
    "(start|stop)_(depth|video)",
    "(get|set)_ir_brightness",
    "(copy|destroy)_registration",
];

fn generate() -> String {
    let function = format!("freenect_({})", FUNCTIONS.join("|"));
    bindgen::Builder::default()
        .header_contents("freenect.h", HEADERS)
        .allowlist_function(function)
        .default_enum_style(bindgen::EnumVariation::Consts)
        .prepend_enum_name(false)
        .generate_comments(false)
        .use_core()
        .formatter(bindgen::Formatter::Prettyplease)
        .disable_header_comment()
        .raw_line("// Made by bindgen from libfreenect's headers, see `lib.rs`; not to be edited.")
        .generate()
        .expect("bindgen reads the headers")
        .to_string()
}

/// With `UPDATE_BINDINGS` set the file is written instead.
#[test]
fn bindings_are_those_of_the_headers() {
    if clang_sys::load().is_err() {
        eprintln!("skipped: no libclang here");
        return;
    }
    if !Path::new("/usr/include/libfreenect.h").exists() {
        eprintln!("skipped: no libfreenect.h here");
        return;
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/bindings.rs");
    let made = generate();
    if std::env::var_os("UPDATE_BINDINGS").is_some() {
        std::fs::write(&path, &made).unwrap();
    }
    let held = std::fs::read_to_string(&path).unwrap();
    assert!(
        held == made,
        "bindings.rs differs from what bindgen makes now; run this test with UPDATE_BINDINGS=1 and look at the difference"
    );
}
