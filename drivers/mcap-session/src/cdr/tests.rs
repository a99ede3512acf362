//! Fields in any order, whole and cut.

use super::*;
use proptest::prelude::*;

/// One field of a message.
#[derive(Clone, Debug, PartialEq)]
enum Field {
    U8(u8),
    U32(u32),
    I32(i32),
    F64s([f64; 3]),
    Sequence(Vec<f64>),
    Text(String),
    Bytes(Vec<u16>),
}

fn field() -> impl Strategy<Value = Field> {
    let number = -1e9..1e9;
    prop_oneof![
        any::<u8>().prop_map(Field::U8),
        any::<u32>().prop_map(Field::U32),
        any::<i32>().prop_map(Field::I32),
        [number.clone(), number.clone(), number.clone()].prop_map(Field::F64s),
        prop::collection::vec(number, 0..5).prop_map(Field::Sequence),
        "[^\0]{0,12}".prop_map(Field::Text),
        prop::collection::vec(any::<u16>(), 0..9).prop_map(Field::Bytes),
    ]
}

fn encode(fields: &[Field]) -> Vec<u8> {
    let mut encoder = Encoder::with_capacity(0);
    for field in fields {
        match field {
            Field::U8(value) => encoder.u8(*value),
            Field::U32(value) => encoder.u32(*value),
            Field::I32(value) => encoder.i32(*value),
            Field::F64s(values) => encoder.f64s(values),
            Field::Sequence(values) => encoder.f64_sequence(values),
            Field::Text(text) => encoder.string(text),
            Field::Bytes(values) => encoder.u16_bytes(values.iter().copied()),
        }
    }
    encoder.finish()
}

fn decode_like(field: &Field, decoder: &mut Decoder) -> Result<Field, CdrError> {
    Ok(match field {
        Field::U8(_) => Field::U8(decoder.u8("u8")?),
        Field::U32(_) => Field::U32(decoder.u32("u32")?),
        Field::I32(_) => Field::I32(decoder.i32("i32")?),
        Field::F64s(_) => Field::F64s(decoder.f64s("f64s")?),
        Field::Sequence(_) => Field::Sequence(decoder.f64_sequence("sequence")?),
        Field::Text(_) => Field::Text(decoder.string("text")?.to_owned()),
        Field::Bytes(_) => {
            let bytes = decoder.bytes("bytes")?.chunks_exact(2);
            Field::Bytes(bytes.map(|b| u16::from_le_bytes([b[0], b[1]])).collect())
        }
    })
}

proptest! {
    #[test]
    fn any_fields_come_back(fields in prop::collection::vec(field(), 0..12)) {
        let message = encode(&fields);
        let mut decoder = Decoder::new(&message).unwrap();
        for field in &fields {
            prop_assert_eq!(&decode_like(field, &mut decoder).unwrap(), field);
        }
        prop_assert_eq!(decoder.at, decoder.body.len());
    }

    #[test]
    fn a_message_that_is_cut_is_an_error(fields in prop::collection::vec(field(), 1..6)) {
        let message = encode(&fields);
        for length in 0..message.len() {
            let read = Decoder::new(&message[..length]).and_then(|mut decoder| {
                fields.iter().try_for_each(|field| decode_like(field, &mut decoder).map(drop))
            });
            let is_truncated = matches!(read, Err(CdrError::Truncated { .. }));
            prop_assert!(is_truncated, "{} of {} bytes: {:?}", length, message.len(), read);
        }
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..64), like in prop::collection::vec(field(), 1..6)) {
        let mut message = ENCAPSULATION.to_vec();
        message.extend(bytes);
        let mut decoder = Decoder::new(&message).unwrap();
        for field in &like {
            if decode_like(field, &mut decoder).is_err() {
                break;
            }
        }
        prop_assert!(decoder.at <= decoder.body.len());
    }
}

#[test]
fn numbers_are_aligned_behind_the_header() {
    let mut encoder = Encoder::with_capacity(0);
    encoder.u8(1);
    encoder.f64s(&[1.0]);
    encoder.string("ab");
    encoder.i32(-1);
    let expected = [
        &[0, 1, 0, 0][..],
        &[1, 0, 0, 0, 0, 0, 0, 0],
        &1f64.to_le_bytes(),
        &[3, 0, 0, 0, b'a', b'b', 0, 0],
        &[255; 4],
    ];
    assert_eq!(encoder.finish(), expected.concat());
}

#[test]
fn big_endian_messages_are_read() {
    let message = [
        &[0, 0, 0, 0][..],
        &[9, 0, 0, 0, 0, 0, 0, 0],
        &1.5f64.to_be_bytes(),
        &7u32.to_be_bytes(),
        &[0, 0, 0, 3, b'a', b'b', 0],
    ]
    .concat();
    let mut decoder = Decoder::new(&message).unwrap();
    assert_eq!(decoder.u8("u8").unwrap(), 9);
    assert_eq!(decoder.f64s("f64s").unwrap(), [1.5]);
    assert_eq!(decoder.u32("u32").unwrap(), 7);
    assert_eq!(decoder.string("text").unwrap(), "ab");
}

#[test]
fn other_encodings_are_named() {
    let error = Decoder::new(&[0, 3, 0, 0, 1]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "encapsulation [00, 03, 00, 00], must be plain CDR: [00, 01, 00, 00] or [00, 00, 00, 00]"
    );
    let mut decoder = Decoder::new(&[0, 1, 0, 0, 9, 0, 0, 0]).unwrap();
    assert_eq!(
        decoder.string("encoding").unwrap_err().to_string(),
        "the message ends in encoding, which needs 9 bytes where 0 are left"
    );
}
