//! A mocked bus: events by umockdev's own library, through the sockets that programs listen on.
#![allow(clippy::unwrap_used, reason = "a test may fail anywhere")]

use std::{
    env,
    ffi::{CString, c_char, c_void},
    process::Command,
    ptr,
};

use libloading::{Library, Symbol};

const DEVICE_PATH: &str = "/devices/pci0000:00/0000:00:14.0/usb1/1-1";

/// Runs `body` in a process of its own in which umockdev stands before the system: the test of that name again.
pub fn run_mocked(test: &str, body: impl FnOnce()) {
    if env::var_os("UNDER_UMOCKDEV").is_some() {
        return body();
    }
    let here = Command::new("umockdev-wrapper").arg("true").status();
    if !here.is_ok_and(|status| status.success()) {
        eprintln!("skipped: needs umockdev");
        return;
    }
    let status = Command::new("umockdev-wrapper")
        .arg(env::current_exe().unwrap())
        .args(["--exact", test, "--nocapture"])
        .env("UNDER_UMOCKDEV", "1")
        .status()
        .unwrap();
    assert!(status.success());
}

/// umockdev's bus; its objects live as long as the process.
pub struct Testbed {
    library: Library,
    raw: *mut c_void,
}

impl Testbed {
    /// A bus with a camera of that product id of Microsoft's and that serial number, of whose coming nobody has been told yet.
    pub fn with_camera(product: u16, serial: &str) -> Self {
        let testbed = Testbed::new();
        testbed.add(&format!(
            "P: {DEVICE_PATH}\nN: bus/usb/001/002\nE: DEVTYPE=usb_device\nE: SUBSYSTEM=usb\nE: PRODUCT=45e/{product:x}/100\n\
             E: ID_SERIAL_SHORT={serial}\nA: idVendor=045e\\n\nA: idProduct={product:04x}\\n\n"
        ));
        testbed
    }

    fn new() -> Self {
        // SAFETY: the library's own start and end do nothing but register types.
        let library = unsafe { Library::new("libumockdev.so.0") }.unwrap();
        let raw = {
            // SAFETY: the function has this signature in umockdev's header.
            let new: Symbol<unsafe extern "C" fn() -> *mut c_void> =
                unsafe { library.get(b"umockdev_testbed_new") }.unwrap();
            // SAFETY: it takes nothing.
            unsafe { new() }
        };
        assert!(!raw.is_null());
        Testbed { library, raw }
    }

    fn add(&self, description: &str) {
        type Add = unsafe extern "C" fn(*mut c_void, *const c_char, *mut *mut c_void) -> i32;
        let text = CString::new(description).unwrap();
        // SAFETY: the function has this signature in umockdev's header.
        let add: Symbol<Add> =
            unsafe { self.library.get(b"umockdev_testbed_add_from_string") }.unwrap();
        // SAFETY: the testbed is alive, the text ends with zero, errors are not asked for.
        assert_ne!(unsafe { add(self.raw, text.as_ptr(), ptr::null_mut()) }, 0);
    }

    /// Tells whoever listens what happens to the Kinect: `add`, `remove` or `change`.
    pub fn tell(&self, action: &str) {
        type Tell = unsafe extern "C" fn(*mut c_void, *const c_char, *const c_char);
        let (path, action) = (
            CString::new(format!("/sys{DEVICE_PATH}")).unwrap(),
            CString::new(action).unwrap(),
        );
        // SAFETY: the function has this signature in umockdev's header.
        let tell: Symbol<Tell> = unsafe { self.library.get(b"umockdev_testbed_uevent") }.unwrap();
        // SAFETY: the testbed is alive and both texts end with zero.
        unsafe { tell(self.raw, path.as_ptr(), action.as_ptr()) };
    }
}
