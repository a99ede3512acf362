//! What stands behind the data of a file: its end, the summary, the footer; in the words of the MCAP specification.

use mcap::{MAGIC, records::op};

use crate::{
    scan::Scan,
    segment::{LIBRARY, PROFILE},
    streams::Stream,
};

/// The bytes that end a file whose data have that checksum and end where the scan says.
pub fn ending(scan: &Scan, data_crc: u32) -> Vec<u8> {
    let mut out = Vec::new();
    record(&mut out, op::DATA_END, &data_crc.to_le_bytes());
    let start = out.len();
    for ((opcode, _), body) in &scan.definitions.records {
        record(&mut out, *opcode, body);
    }
    record(&mut out, op::STATISTICS, &statistics(scan));
    for chunk in &scan.chunks {
        let mut body = Body::default();
        body.number(chunk.time_ns.0);
        body.number(chunk.time_ns.1);
        body.number(chunk.offset);
        body.number(chunk.length);
        // An index that does not hold all messages would hide the others; without one the chunk is read as a whole.
        match chunk.is_indexed() {
            true => {
                body.map(
                    chunk
                        .index_offsets
                        .iter()
                        .map(|(&id, &offset)| (id, offset)),
                );
                body.number(chunk.index_length);
            }
            false => {
                body.map(std::iter::empty());
                body.number(0);
            }
        }
        body.text(&chunk.compression);
        body.number(chunk.compressed_size);
        body.number(chunk.uncompressed_size);
        record(&mut out, op::CHUNK_INDEX, &body.0);
    }

    let mut footer = Body::default();
    footer.number(scan.end_of_data + start as u64);
    // No offsets of groups within the summary: they are for summaries too long to read.
    footer.number(0);
    out.push(op::FOOTER);
    out.extend((footer.0.len() as u64 + 4).to_le_bytes());
    out.extend(footer.0);
    let crc = crc32fast::hash(&out[start..]);
    out.extend(crc.to_le_bytes());
    out.extend(MAGIC);
    out
}

/// Schemas and channels of a recording of Relief, as [`crate::segment`] numbers them: kind, number and contents of each record.
pub fn own_definitions(serial: &str) -> Vec<((u8, u16), Vec<u8>)> {
    let mut names = Vec::new();
    let mut records = Vec::new();
    for (stream, channel_id) in Stream::ALL.into_iter().zip(1u16..) {
        let schema = stream.schema();
        let known = names.iter().position(|name| *name == schema.name);
        let schema_id = known.unwrap_or_else(|| {
            names.push(schema.name);
            let mut body = Body::default();
            body.0.extend((names.len() as u16).to_le_bytes());
            body.text(schema.name);
            body.text("ros2msg");
            body.text(schema.text);
            records.push(((op::SCHEMA, names.len() as u16), body.0));
            names.len() - 1
        }) as u16
            + 1;
        let mut body = Body::default();
        body.0.extend(channel_id.to_le_bytes());
        body.0.extend(schema_id.to_le_bytes());
        body.text(&stream.topic(serial));
        body.text("cdr");
        let mut metadata = Body::default();
        metadata.text("offered_qos_profiles");
        metadata.text("");
        body.length(metadata.0.len());
        body.0.extend(metadata.0);
        records.push(((op::CHANNEL, channel_id), body.0));
    }
    records
}

/// A header record of exactly `length` bytes, if that is enough for one that tells whose it is.
pub fn header(length: u64) -> Option<Vec<u8>> {
    let library = usize::try_from(length).ok()?.checked_sub(9 + 4 + 4 + 4)?;
    if library < LIBRARY.len() {
        return None;
    }
    let mut body = Body::default();
    body.text(PROFILE);
    let name = format!("{LIBRARY}repaired");
    body.text(&format!("{name:<library$.library$}"));
    let mut out = Vec::new();
    record(&mut out, op::HEADER, &body.0);
    Some(out)
}

fn statistics(scan: &Scan) -> Vec<u8> {
    let of_kind = |kind| {
        let kinds = scan.definitions.records.keys();
        kinds.filter(|(opcode, _)| *opcode == kind).count() as u32
    };
    let (start, end) = scan.summary.time_ns.unwrap_or_default();
    let mut body = Body::default();
    body.number(scan.n_messages.values().sum());
    body.0.extend((of_kind(op::SCHEMA) as u16).to_le_bytes());
    for count in [of_kind(op::CHANNEL), 0, 0, scan.chunks.len() as u32] {
        body.0.extend(count.to_le_bytes());
    }
    body.number(start);
    body.number(end);
    body.map(scan.n_messages.iter().map(|(&id, &n)| (id, n)));
    body.0
}

fn record(out: &mut Vec<u8>, opcode: u8, body: &[u8]) {
    out.push(opcode);
    out.extend((body.len() as u64).to_le_bytes());
    out.extend(body);
}

/// The contents of a record, little endian.
#[derive(Default)]
struct Body(Vec<u8>);

impl Body {
    fn number(&mut self, value: u64) {
        self.0.extend(value.to_le_bytes());
    }

    fn length(&mut self, length: usize) {
        self.0.extend((length as u32).to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        self.length(text.len());
        self.0.extend(text.as_bytes());
    }

    fn map(&mut self, entries: impl Iterator<Item = (u16, u64)>) {
        let entries: Vec<u8> = entries
            .flat_map(|(key, value)| key.to_le_bytes().into_iter().chain(value.to_le_bytes()))
            .collect();
        self.length(entries.len());
        self.0.extend(entries);
    }
}
