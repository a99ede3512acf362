//! The header of a PLY file: which elements follow, and how their properties are stored.

use std::borrow::Cow;

/// A number type of a property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }
}

/// One property of an element: a number, or a list with its own count.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Property {
    pub name: String,
    /// The type of the count, if the property is a list.
    pub count: Option<Scalar>,
    /// The type of the value or values.
    pub value: Scalar,
}

/// A table of the file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Element {
    pub name: String,
    pub n_rows: usize,
    pub properties: Vec<Property>,
}

/// How numbers are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    BinaryLittleEndian,
}

/// A whole header.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Header {
    pub encoding: Encoding,
    pub elements: Vec<Element>,
}

const NO_END: &str = "truncated, the header has no end_header";

/// Splits a file into its header and the bytes behind it; the error says what is wrong.
pub(super) fn parse_header(bytes: &[u8]) -> Result<(Header, &[u8]), String> {
    let (magic, mut rest) = next_line(bytes).unwrap_or((Cow::Borrowed(""), bytes));
    if magic != "ply" {
        return Err("not a PLY file, the first line is not `ply`".into());
    }
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let Some((line, behind)) = next_line(rest) else {
            return Err(NO_END.into());
        };
        rest = behind;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => break,
            [] | ["comment" | "obj_info", ..] => {}
            ["format", name, _version] => encoding = Some(parse_encoding(name)?),
            ["element", name, n_rows] => elements.push(Element {
                name: (*name).into(),
                n_rows: n_rows
                    .parse()
                    .map_err(|_| format!("`{line}` does not state a number of rows"))?,
                properties: Vec::new(),
            }),
            ["property", ..] => elements
                .last_mut()
                .ok_or_else(|| format!("`{line}` stands before any element"))?
                .properties
                .push(parse_property(&line, &words)?),
            // What is neither a keyword nor text is no more of the header.
            _ if matches!(line, Cow::Owned(_)) => return Err(NO_END.into()),
            _ => return Err(format!("header line `{line}` is unknown")),
        }
    }
    let encoding = encoding.ok_or("the header states no format")?;
    Ok((Header { encoding, elements }, rest))
}

/// The first line as text, without its end, and the bytes behind it; `None` if no line ends. Keywords are ASCII; what a comment
/// says may be in any encoding.
fn next_line(bytes: &[u8]) -> Option<(Cow<'_, str>, &[u8])> {
    let end = bytes.iter().position(|&byte| byte == b'\n')?;
    let line = &bytes[..end];
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    Some((String::from_utf8_lossy(line), &bytes[end + 1..]))
}

fn parse_encoding(name: &str) -> Result<Encoding, String> {
    match name {
        "ascii" => Ok(Encoding::Ascii),
        "binary_little_endian" => Ok(Encoding::BinaryLittleEndian),
        _ => Err(format!(
            "format {name} is not supported, only ascii and binary_little_endian"
        )),
    }
}

fn parse_property(line: &str, words: &[&str]) -> Result<Property, String> {
    let scalar = |name: &str| {
        Scalar::from_name(name).ok_or_else(|| format!("`{line}`: unknown type {name}"))
    };
    match words {
        ["property", "list", count, value, name] => Ok(Property {
            name: (*name).into(),
            count: Some(scalar(count)?),
            value: scalar(value)?,
        }),
        ["property", value, name] => Ok(Property {
            name: (*name).into(),
            count: None,
            value: scalar(value)?,
        }),
        _ => Err(format!("`{line}` is not a property")),
    }
}
