//! The device's phase tables: what the reference signal lags behind at each pixel.

use std::fmt;

use crate::{HEIGHT, WIDTH};

/// Modulation frequencies.
pub(crate) const N_FREQUENCIES: usize = 3;
const HEADER_BYTES: usize = 32;
/// Two bytes of unknown meaning stand before and after each table.
const PAD_BYTES: usize = 2;
const TABLE_BYTES: usize = 2 * WIDTH * HEIGHT;
const STRIDE_BYTES: usize = TABLE_BYTES + 2 * PAD_BYTES;
/// Bytes of the device's answer to the command for its phase tables.
pub const P0_RESPONSE_BYTES: usize = HEADER_BYTES + N_FREQUENCIES * STRIDE_BYTES;

/// A phase of one unit of a table, half turns.
const HALF_TURNS_PER_UNIT: f64 = 0.000_031;

/// An answer of the wrong size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct P0LengthError {
    /// Bytes that were there.
    pub length: usize,
}

impl P0LengthError {
    /// The first field that is not whole, and its place; `None` if bytes are left over.
    fn missing_field(self) -> Option<(&'static str, usize, usize)> {
        let table = |k: usize| {
            let start = HEADER_BYTES + k * STRIDE_BYTES + PAD_BYTES;
            (start, start + TABLE_BYTES)
        };
        let fields = [
            ("header", (0, HEADER_BYTES)),
            ("p0_table_0", table(0)),
            ("p0_table_1", table(1)),
            ("p0_table_2", table(2)),
            (
                "closing pad",
                (P0_RESPONSE_BYTES - PAD_BYTES, P0_RESPONSE_BYTES),
            ),
        ];
        let mut cut = fields
            .into_iter()
            .filter(|(_, (_, end))| self.length < *end);
        cut.next().map(|(name, (start, end))| (name, start, end))
    }
}

impl fmt::Display for P0LengthError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let length = self.length;
        match self.missing_field() {
            Some((field, start, end)) => write!(
                f,
                "P0 response has {length} bytes, must have {P0_RESPONSE_BYTES}: \
                 {field} at offset {start} ends at {end}"
            ),
            None => write!(
                f,
                "P0 response has {length} bytes, must have {P0_RESPONSE_BYTES}"
            ),
        }
    }
}

impl std::error::Error for P0LengthError {}

/// The phase of the reference signal at each pixel and frequency, as the device keeps it.
///
/// Rows are those of the image from the top, columns mirrored as the packets are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct P0Tables {
    tables: [Vec<u16>; N_FREQUENCIES],
}

impl P0Tables {
    /// Reads the device's answer: a header of 32 bytes, then three tables of 424 rows of 512 16-bit little-endian
    /// numbers, two bytes before and after each.
    ///
    /// # Errors
    /// [`P0LengthError`] naming the field that is cut off, its offset and its end.
    pub fn from_response(response: &[u8]) -> Result<Self, P0LengthError> {
        if response.len() != P0_RESPONSE_BYTES {
            return Err(P0LengthError {
                length: response.len(),
            });
        }
        let table = |k: usize| {
            let start = HEADER_BYTES + k * STRIDE_BYTES + PAD_BYTES;
            let pairs = response[start..start + TABLE_BYTES].chunks_exact(2);
            pairs
                .map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
                .collect()
        };
        Ok(P0Tables {
            tables: [table(0), table(1), table(2)],
        })
    }

    /// The phase added to that of the light's travel, radians.
    pub(crate) fn phase_rad(&self, frequency: usize, u: usize, v: usize) -> f64 {
        let units = f64::from(self.tables[frequency][v * WIDTH + u]);
        -units * HALF_TURNS_PER_UNIT * std::f64::consts::PI
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_lie_where_the_format_has_them() {
        assert_eq!(P0_RESPONSE_BYTES, 1_302_572);
        let mut response = vec![0; P0_RESPONSE_BYTES];
        // Frequency 1, row 2, column 3.
        let place = 32 + 434_180 + 2 + 2 * (2 * 512 + 3);
        response[place..place + 2].copy_from_slice(&1000u16.to_le_bytes());
        let tables = P0Tables::from_response(&response).unwrap();
        let expected = -0.031 * std::f64::consts::PI;
        assert!((tables.phase_rad(1, 3, 2) - expected).abs() < 1e-12);
        assert_eq!(tables.phase_rad(1, 4, 2), 0.0);
    }

    #[test]
    fn a_cut_answer_names_what_is_missing() {
        let cut = |length| {
            P0Tables::from_response(&vec![0; length])
                .unwrap_err()
                .to_string()
        };
        assert_eq!(
            cut(7),
            "P0 response has 7 bytes, must have 1302572: header at offset 0 ends at 32"
        );
        assert_eq!(
            cut(500_000),
            "P0 response has 500000 bytes, must have 1302572: p0_table_1 at offset 434214 ends at 868390"
        );
        assert!(cut(1_302_571).contains("closing pad at offset 1302570"));
        assert_eq!(
            cut(1_302_573),
            "P0 response has 1302573 bytes, must have 1302572"
        );
    }
}
