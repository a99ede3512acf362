//! What the chunks of a file hold: definitions and messages.

use std::collections::BTreeMap;

use mcap::{
    parse_record,
    records::{MessageHeader, Record, op},
};

use crate::{segment::LIBRARY, summary::own_definitions};

/// A channel: what its messages are about, and how they are stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Channel {
    /// The topic.
    pub topic: String,
    /// The type of the messages; empty for none.
    pub message_type: String,
    /// The encoding of the messages; `cdr` is what is read here.
    pub encoding: String,
}

impl Channel {
    /// Whether its messages are of that type of `sensor_msgs`. In bags of ROS 1 types have no `msg/` in their names.
    pub fn carries_sensor_msg(&self, name: &str) -> bool {
        let of_package = self.message_type.strip_prefix("sensor_msgs/");
        of_package.is_some_and(|rest| rest.strip_prefix("msg/").unwrap_or(rest) == name)
    }
}

/// The definitions of a file so far.
#[derive(Clone, Debug, Default)]
pub struct Definitions {
    /// Type by number.
    schemas: BTreeMap<u16, String>,
    /// By number.
    pub channels: BTreeMap<u16, Channel>,
    /// As they lie in the file: schemas and channels by number.
    pub records: BTreeMap<(u8, u16), Vec<u8>>,
}

impl Definitions {
    /// Takes up a definition; one that came before under the same number gives way.
    ///
    /// # Errors
    /// If the record is damaged.
    pub fn add(&mut self, opcode: u8, body: &[u8]) -> Result<(), String> {
        match parse_record(opcode, body).map_err(|error| error.to_string())? {
            Record::Schema { header, .. } => {
                self.records.insert((opcode, header.id), body.to_vec());
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                self.records.insert((opcode, channel.id), body.to_vec());
                let message_type = self.schemas.get(&channel.schema_id).cloned();
                self.channels.insert(
                    channel.id,
                    Channel {
                        topic: channel.topic,
                        message_type: message_type.unwrap_or_default(),
                        encoding: channel.message_encoding,
                    },
                );
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes up a file's header, which tells whether Relief wrote it.
    pub fn begin(&mut self, header: &[u8]) {
        if let Ok(Record::Header(header)) = parse_record(op::HEADER, header)
            && header.library.starts_with(LIBRARY)
        {
            self.add_own();
        }
    }

    /// What a recording of Relief defines is known before the file's own definitions, which may be lost.
    pub fn add_own(&mut self) {
        for ((opcode, _), body) in own_definitions("lost") {
            let added = self.add(opcode, &body);
            debug_assert_eq!(added, Ok(()), "definitions that this program writes");
        }
    }
}

/// One message of a file.
#[derive(Clone, Copy, Debug)]
pub struct Message<'a> {
    /// Its channel, sequence number and times.
    pub header: MessageHeader,
    /// Where it lies among the records of its chunk.
    pub offset_in_chunk: u64,
    /// Its bytes.
    pub data: &'a [u8],
}

/// Takes up the definitions among the records of a chunk, and hands on its messages.
///
/// # Errors
/// What is wrong with the records.
pub fn read_records(
    records: &[u8],
    definitions: &mut Definitions,
    mut on_message: impl FnMut(&Definitions, Message),
) -> Result<(), String> {
    let mut rest = records;
    while !rest.is_empty() {
        let offset_in_chunk = (records.len() - rest.len()) as u64;
        let (opcode, body, after) = split_record(rest)
            .ok_or_else(|| format!("a record {offset_in_chunk} bytes into it is cut"))?;
        match opcode {
            op::SCHEMA | op::CHANNEL => definitions.add(opcode, body)?,
            op::MESSAGE => {
                let (header, data) = message(body).ok_or("a message without its header")?;
                on_message(
                    definitions,
                    Message {
                        header,
                        offset_in_chunk,
                        data,
                    },
                );
            }
            _ => {}
        }
        rest = after;
    }
    Ok(())
}

/// The header and the bytes of a message.
pub fn message(body: &[u8]) -> Option<(MessageHeader, &[u8])> {
    let (channel, rest) = body.split_first_chunk()?;
    let (sequence, rest) = rest.split_first_chunk()?;
    let (log_time, rest) = rest.split_first_chunk()?;
    let (publish_time, data) = rest.split_first_chunk()?;
    let header = MessageHeader {
        channel_id: u16::from_le_bytes(*channel),
        sequence: u32::from_le_bytes(*sequence),
        log_time: u64::from_le_bytes(*log_time),
        publish_time: u64::from_le_bytes(*publish_time),
    };
    Some((header, data))
}

/// Opcode and contents of the first record, and what follows.
fn split_record(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let (&opcode, rest) = bytes.split_first()?;
    let (length, rest) = rest.split_first_chunk()?;
    let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
    let (body, after) = rest.split_at_checked(length)?;
    Some((opcode, body, after))
}
