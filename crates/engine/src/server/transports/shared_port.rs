//! A port for both Modbus TCP and Raw Ingest packets: the first bytes of a connection decide which.

use holdfast_protocol::raw_ingest::MAGIC;

/// The most bytes that are needed to tell a packet from a Modbus frame.
pub(crate) const DECISIVE_BYTES: usize = 4;

/// What the first bytes of a connection, or of what follows a frame, begin.
pub(crate) enum Beginning {
    Packet,
    /// A Modbus frame, or what is to be judged as one.
    Modbus,
    /// More bytes are needed.
    Unknown,
}

impl Beginning {
    /// Behind the magic, a Modbus frame has its protocol id, which is 0; a packet has its version and what
    /// follows it. If that is not 0, but wrong, the packet is refused, so that its sender gets a reply.
    pub(crate) fn of(bytes: &[u8]) -> Beginning {
        let magic = &bytes[..bytes.len().min(MAGIC.len())];
        let after = &bytes[magic.len()..];
        if !MAGIC.starts_with(magic) {
            Beginning::Modbus
        } else if after.iter().take(2).any(|byte| *byte != 0) {
            Beginning::Packet
        } else if bytes.len() >= DECISIVE_BYTES {
            Beginning::Modbus
        } else {
            Beginning::Unknown
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether these bytes begin a packet; `None` if more are needed.
    fn begins(bytes: &[u8]) -> Option<bool> {
        match Beginning::of(bytes) {
            Beginning::Packet => Some(true),
            Beginning::Modbus => Some(false),
            Beginning::Unknown => None,
        }
    }

    #[test]
    fn modbus_frames_are_told_from_packets_by_their_protocol_id() {
        for transaction in 0..=u16::MAX {
            let [high, low] = transaction.to_be_bytes();
            assert_eq!(begins(&[high, low, 0, 0]), Some(false), "{transaction:04x}");
        }
        for len in 0..4 {
            assert_eq!(begins(&b"RI\0\0"[..len]), None, "{len} bytes");
        }
    }

    #[test]
    fn what_has_the_magic_and_no_protocol_id_is_a_packet_whatever_its_version_and_area() {
        for version in 0..=255 {
            for area in 0..=255 {
                let packet = (version, area) != (0, 0);
                assert_eq!(begins(&[b'R', b'I', version, area]), Some(packet));
            }
            assert_eq!(begins(&[b'R', b'I', version]), (version != 0).then_some(true));
        }
        assert_eq!(
            (begins(b"rI\x01\x03"), begins(b"Ri"), begins(b"S")),
            (Some(false), Some(false), Some(false))
        );
    }
}
