//! What stands in a message of udev's: a header, then lines `KEY=value`, each ended by a zero byte.

/// How each message begins.
const PREFIX: &[u8] = b"libudev\0";
const MAGIC: u32 = 0xfeed_cafe;

/// Where numbers of the header stand, bytes from the message's start: the magic in network order, the rest in the machine's.
const MAGIC_AT: usize = 8;
const PROPERTIES_OFFSET_AT: usize = 16;
const PROPERTIES_LENGTH_AT: usize = 20;

/// What happened to a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// It was plugged in, and has its permissions.
    Added,
    /// It was unplugged.
    Removed,
}

/// A USB device has come or gone.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UsbEvent {
    /// Which of them.
    pub action: Action,
    /// Where it is or was plugged in, as in `2-1.4`.
    pub port: String,
    /// Vendor and product id.
    pub ids: Option<(u16, u16)>,
    /// Its serial number, where udev has read one.
    pub serial: Option<String>,
}

impl UsbEvent {
    /// The event in a message; `None` for what is not udev's, of another subsystem, of an interface, or neither coming nor going.
    pub(crate) fn parse(message: &[u8]) -> Option<Self> {
        let properties = properties(message)?;
        let value = |key: &str| {
            let mut lines = properties.split(|byte| *byte == 0);
            let value =
                lines.find_map(|line| line.strip_prefix(key.as_bytes())?.strip_prefix(b"="))?;
            std::str::from_utf8(value).ok()
        };
        if value("SUBSYSTEM") != Some("usb") || value("DEVTYPE") != Some("usb_device") {
            return None;
        }
        Some(UsbEvent {
            action: match value("ACTION")? {
                "add" => Action::Added,
                "remove" => Action::Removed,
                _ => return None,
            },
            port: value("DEVPATH")?.rsplit('/').next()?.to_owned(),
            ids: value("PRODUCT").and_then(ids),
            serial: value("ID_SERIAL_SHORT").map(str::to_owned),
        })
    }
}

/// The part of a message that holds the properties.
fn properties(message: &[u8]) -> Option<&[u8]> {
    let word = |at: usize| -> Option<[u8; 4]> { message.get(at..at + 4)?.try_into().ok() };
    if !message.starts_with(PREFIX) || u32::from_be_bytes(word(MAGIC_AT)?) != MAGIC {
        return None;
    }
    let start = u32::from_ne_bytes(word(PROPERTIES_OFFSET_AT)?) as usize;
    let length = u32::from_ne_bytes(word(PROPERTIES_LENGTH_AT)?) as usize;
    message.get(start..start.checked_add(length)?)
}

/// Vendor and product in `PRODUCT`, which is `45e/2ae/10b` for a Kinect: the third is the release.
fn ids(product: &str) -> Option<(u16, u16)> {
    let mut numbers = product.split('/');
    let mut id = || u16::from_str_radix(numbers.next()?, 16).ok();
    Some((id()?, id()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(properties: &[&str]) -> Vec<u8> {
        let lines: Vec<u8> = properties
            .iter()
            .flat_map(|line| [line.as_bytes(), &[0]].concat())
            .collect();
        let mut message = PREFIX.to_vec();
        message.extend(MAGIC.to_be_bytes());
        message.extend(40_u32.to_ne_bytes());
        message.extend(40_u32.to_ne_bytes());
        message.extend((lines.len() as u32).to_ne_bytes());
        message.extend([0; 16]);
        message.extend(lines);
        message
    }

    const ADDED: [&str; 6] = [
        "ACTION=add",
        "DEVPATH=/devices/pci0000:00/0000:00:14.0/usb2/2-1/2-1.4",
        "SUBSYSTEM=usb",
        "DEVTYPE=usb_device",
        "PRODUCT=45e/2ae/10b",
        "ID_SERIAL_SHORT=A7",
    ];

    #[test]
    fn a_device_that_comes_is_named() {
        let event = UsbEvent::parse(&message(&ADDED)).unwrap();
        let expected = UsbEvent {
            action: Action::Added,
            port: "2-1.4".to_owned(),
            ids: Some((0x045e, 0x02ae)),
            serial: Some("A7".to_owned()),
        };
        assert_eq!(event, expected);
        let mut bare = ADDED[..4].to_vec();
        bare[0] = "ACTION=remove";
        let event = UsbEvent::parse(&message(&bare)).unwrap();
        assert_eq!(
            (event.action, event.ids, event.serial),
            (Action::Removed, None, None)
        );
    }

    #[test]
    fn what_is_no_such_event_is_passed_over() {
        for (at, other) in [
            (0, "ACTION=bind"),
            (2, "SUBSYSTEM=block"),
            (3, "DEVTYPE=usb_interface"),
            (1, "PATH=/devices"),
        ] {
            let mut lines = ADDED.to_vec();
            lines[at] = other;
            assert_eq!(UsbEvent::parse(&message(&lines)), None, "{other}");
        }
        let whole = message(&ADDED);
        assert_eq!(
            UsbEvent::parse(b"add@/devices/usb1/1-1\0ACTION=add\0"),
            None
        );
        // Cut, or with one byte changed: no panic, whatever comes of it.
        for n_bytes in 0..whole.len() {
            assert_eq!(UsbEvent::parse(&whole[..n_bytes]), None);
            for byte in [0, 0x7f, 0xff] {
                let mut changed = whole.clone();
                changed[n_bytes] = byte;
                let _ = UsbEvent::parse(&changed);
            }
        }
    }
}
