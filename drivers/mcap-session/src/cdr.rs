//! CDR, the encoding of ROS 2 messages: every number aligned to its size behind a header of four bytes. It is written little endian and
//! read in either order.
//!
//! Strings are `uint32` length (with the closing zero), bytes and zero; sequences are `uint32` count and items; arrays are items
//! alone. Not handled: wide strings, and the parameter lists of later versions, which ROS 2 does not write.

use std::str;

/// Plain CDR, little endian, no options.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];
/// The same, big endian.
const BIG_ENDIAN: [u8; 4] = [0, 0, 0, 0];

/// Why bytes are not the message that they should be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The first four bytes announce another encoding.
    #[error("encapsulation {0:02x?}, must be plain CDR: {ENCAPSULATION:02x?} or {BIG_ENDIAN:02x?}")]
    Encapsulation([u8; 4]),
    /// The message ends too early.
    #[error("the message ends in {field}, which needs {needed} bytes where {left} are left")]
    Truncated {
        /// What was being read.
        field: &'static str,
        /// Bytes that it takes.
        needed: usize,
        /// Bytes that are there.
        left: usize,
    },
    /// A string that is none.
    #[error("{field} is no text in UTF-8 that ends with a zero")]
    NotText {
        /// What was being read.
        field: &'static str,
    },
}

/// Builds one message.
#[derive(Debug)]
pub struct Encoder {
    bytes: Vec<u8>,
}

impl Encoder {
    /// An empty message, with room for `capacity` bytes.
    pub fn with_capacity(capacity: usize) -> Self {
        let mut bytes = Vec::with_capacity(ENCAPSULATION.len() + capacity);
        bytes.extend(ENCAPSULATION);
        Encoder { bytes }
    }

    /// The whole message.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// `uint8` or `bool`.
    pub fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    /// `uint32`.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    /// `int32`.
    pub fn i32(&mut self, value: i32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    /// `float64[N]`, or N single `float64`.
    pub fn f64s(&mut self, values: &[f64]) {
        for value in values {
            self.align(8);
            self.bytes.extend(value.to_le_bytes());
        }
    }

    /// `float64[]`.
    pub fn f64_sequence(&mut self, values: &[f64]) {
        self.u32(values.len() as u32);
        self.f64s(values);
    }

    /// `string`.
    pub fn string(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }

    /// `uint8[]` that holds 16-bit values.
    pub fn u16_bytes(&mut self, values: impl ExactSizeIterator<Item = u16>) {
        self.u32(2 * values.len() as u32);
        self.bytes.extend(values.flat_map(u16::to_le_bytes));
    }

    fn align(&mut self, size: usize) {
        let body = self.bytes.len() - ENCAPSULATION.len();
        let padded = ENCAPSULATION.len() + body.next_multiple_of(size);
        self.bytes.resize(padded, 0);
    }
}

/// Reads one message, field by field; every length is checked before anything is taken.
#[derive(Clone, Debug)]
pub struct Decoder<'a> {
    body: &'a [u8],
    at: usize,
    is_big_endian: bool,
}

impl<'a> Decoder<'a> {
    /// A decoder behind the encapsulation header.
    ///
    /// # Errors
    /// [`CdrError`] for a message in another encoding, or of less than four bytes.
    pub fn new(message: &'a [u8]) -> Result<Self, CdrError> {
        let Some((head, body)) = message.split_first_chunk::<4>() else {
            return Err(CdrError::Truncated {
                field: "encapsulation",
                needed: ENCAPSULATION.len(),
                left: message.len(),
            });
        };
        // The last two bytes are options, which say nothing of how to read.
        let is_big_endian = head[..2] == BIG_ENDIAN[..2];
        if !is_big_endian && head[..2] != ENCAPSULATION[..2] {
            return Err(CdrError::Encapsulation(*head));
        }
        Ok(Decoder {
            body,
            at: 0,
            is_big_endian,
        })
    }

    /// `uint8` or `bool`.
    ///
    /// # Errors
    /// [`CdrError::Truncated`], as for all that follow.
    pub fn u8(&mut self, field: &'static str) -> Result<u8, CdrError> {
        Ok(self.take(field, 1, 1)?[0])
    }

    /// `uint32`.
    ///
    /// # Errors
    /// See [`Self::u8`].
    pub fn u32(&mut self, field: &'static str) -> Result<u32, CdrError> {
        Ok(u32::from_le_bytes(self.array(field)?))
    }

    /// `int32`.
    ///
    /// # Errors
    /// See [`Self::u8`].
    pub fn i32(&mut self, field: &'static str) -> Result<i32, CdrError> {
        Ok(i32::from_le_bytes(self.array(field)?))
    }

    /// `float64[N]`, or N single `float64`.
    ///
    /// # Errors
    /// See [`Self::u8`].
    pub fn f64s<const N: usize>(&mut self, field: &'static str) -> Result<[f64; N], CdrError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array(field)?);
        }
        Ok(values)
    }

    /// `float64[]`.
    ///
    /// # Errors
    /// See [`Self::u8`].
    pub fn f64_sequence(&mut self, field: &'static str) -> Result<Vec<f64>, CdrError> {
        let count = self.u32(field)? as usize;
        let left = self.body.len() - self.at;
        let needed = count.saturating_mul(8);
        if needed > left {
            return Err(CdrError::Truncated {
                field,
                needed,
                left,
            });
        }
        let value = |_| Ok(f64::from_le_bytes(self.array(field)?));
        (0..count).map(value).collect()
    }

    /// `string`.
    ///
    /// # Errors
    /// See [`Self::u8`]; [`CdrError::NotText`].
    pub fn string(&mut self, field: &'static str) -> Result<&'a str, CdrError> {
        let length = self.u32(field)? as usize;
        let bytes = self.take(field, 1, length)?;
        let text = match bytes.split_last() {
            Some((0, text)) => text,
            // Some writers send an empty string without its zero.
            None => bytes,
            Some(_) => return Err(CdrError::NotText { field }),
        };
        str::from_utf8(text).map_err(|_| CdrError::NotText { field })
    }

    /// `uint8[]`.
    ///
    /// # Errors
    /// See [`Self::u8`].
    pub fn bytes(&mut self, field: &'static str) -> Result<&'a [u8], CdrError> {
        let length = self.u32(field)? as usize;
        self.take(field, 1, length)
    }

    /// The bytes of a number, the least first.
    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], CdrError> {
        let bytes = self.take(field, N, N)?;
        let mut bytes: [u8; N] = std::array::from_fn(|index| bytes[index]);
        if self.is_big_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    fn take(
        &mut self,
        field: &'static str,
        alignment: usize,
        length: usize,
    ) -> Result<&'a [u8], CdrError> {
        let start = self.at.next_multiple_of(alignment);
        let rest = self.body.get(start..).unwrap_or_default();
        let bytes = rest.get(..length).ok_or(CdrError::Truncated {
            field,
            needed: length,
            left: rest.len(),
        })?;
        self.at = start + length;
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests;
