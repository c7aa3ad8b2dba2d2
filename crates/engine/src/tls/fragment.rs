//! The longest fragment that a client asks for in its ClientHello (RFC 6066, 4).
//!
//! rustls neither reads nor answers this extension. Without an answer, a client must not rely on it.
//! But a client with little memory can read everything that it gets, if the server keeps to it.

/// The first byte of a record with handshake messages, and the length of its header.
const HANDSHAKE: u8 = 22;
pub(super) const RECORD_HEADER_LEN: usize = 5;

/// The type of a ClientHello, and the lengths of its version and random number.
const CLIENT_HELLO: u8 = 1;
const FIXED_LEN: usize = 2 + 32;

/// The type of the extension.
const MAX_FRAGMENT_LENGTH: u16 = 1;

/// The most bytes that are searched. Clients with little memory send less.
const MAX_LEN: usize = 4 * 1024;

/// The lengths that can be asked for, by their codes from 1.
pub(super) const LENGTHS: [usize; 4] = [512, 1024, 2048, 4096];

/// What the first bytes of a client tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Asked {
    /// The index of a length in [`LENGTHS`].
    Length(usize),
    Nothing,
    /// More bytes are needed.
    Unknown,
}

/// Looks for the length in the first bytes of a client.
pub(super) fn asked(bytes: &[u8]) -> Asked {
    let (message, is_cut) = message(bytes);
    match found(&message) {
        Some(code) => match (code as usize).checked_sub(1).filter(|index| *index < LENGTHS.len()) {
            Some(index) => Asked::Length(index),
            None => Asked::Nothing,
        },
        None if is_cut && bytes.len() < MAX_LEN => Asked::Unknown,
        None => Asked::Nothing,
    }
}

/// The ClientHello without its header, as far as it has arrived, and whether it is incomplete.
fn message(mut bytes: &[u8]) -> (Vec<u8>, bool) {
    let mut message = Vec::new();
    while let [HANDSHAKE, _, _, high, low, rest @ ..] = bytes {
        let len = usize::from(u16::from_be_bytes([*high, *low]));
        message.extend_from_slice(&rest[..len.min(rest.len())]);
        bytes = rest.get(len..).unwrap_or_default();
    }
    let is_record_cut =
        bytes.len() < RECORD_HEADER_LEN && bytes.first().is_none_or(|first| *first == HANDSHAKE);
    match message.as_slice() {
        [CLIENT_HELLO, high, middle, low, hello @ ..] => {
            let len = u32::from_be_bytes([0, *high, *middle, *low]) as usize;
            let is_cut = hello.len() < len && is_record_cut;
            (hello[..len.min(hello.len())].to_vec(), is_cut)
        }
        [] | [CLIENT_HELLO, ..] => (Vec::new(), is_record_cut),
        _ => (Vec::new(), false),
    }
}

/// The code in the extension of a ClientHello.
fn found(hello: &[u8]) -> Option<u8> {
    let rest = hello.get(FIXED_LEN..)?;
    let (_session_id, rest) = short(rest)?;
    let (_cipher_suites, rest) = long(rest)?;
    let (_compressions, rest) = short(rest)?;
    let (mut extensions, _) = long(rest)?;
    while let [high, low, rest @ ..] = extensions {
        let (content, rest) = long(rest)?;
        if u16::from_be_bytes([*high, *low]) == MAX_FRAGMENT_LENGTH {
            return content.first().copied().filter(|_| content.len() == 1);
        }
        extensions = rest;
    }
    None
}

/// Splits off content behind a length of one byte.
fn short(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (len, rest) = bytes.split_first()?;
    rest.split_at_checked(usize::from(*len))
}

/// Splits off content behind a length of two bytes.
fn long(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (len, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(usize::from(u16::from_be_bytes(*len)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A ClientHello with that code, in records of at most `record` bytes.
    fn hello(code: Option<&[u8]>, record: usize) -> Vec<u8> {
        let mut extensions = vec![0, 23, 0, 0];
        if let Some(content) = code {
            extensions.extend([0, 1, 0, content.len() as u8]);
            extensions.extend(content);
        }
        extensions.extend([0, 43, 0, 3, 2, 3, 4]);
        let mut hello = [&[3, 3][..], &[7; 32], &[2, 8, 8], &[0, 2, 0x13, 1], &[1, 0]].concat();
        hello.extend((extensions.len() as u16).to_be_bytes());
        hello.extend(extensions);
        let message = [&[1, 0, 0, hello.len() as u8][..], &hello].concat();
        let records = message
            .chunks(record)
            .map(|part| [&[22, 3, 1, 0, part.len() as u8][..], part].concat());
        records.collect::<Vec<_>>().concat()
    }

    #[test]
    fn a_length_is_found_as_soon_as_it_has_arrived_and_never_another() {
        for record in [1, 7, 200] {
            for (content, expected) in [
                (Some(&[1][..]), Asked::Length(0)),
                (Some(&[4]), Asked::Length(3)),
                (Some(&[0]), Asked::Nothing),
                (Some(&[5]), Asked::Nothing),
                (Some(&[1, 1]), Asked::Nothing),
                (Some(&[]), Asked::Nothing),
                (None, Asked::Nothing),
            ] {
                let bytes = hello(content, record);
                assert_eq!(asked(&bytes), expected);
                for cut in 0..bytes.len() {
                    let told = asked(&bytes[..cut]);
                    assert!(told == Asked::Unknown || told == expected, "{told:?} at {cut}");
                }
            }
        }
    }

    #[test]
    fn other_bytes_ask_for_nothing() {
        for bytes in [&b"\0\x01\0\0\0\x06\x01\x03\0\0\0\x01"[..], b"GET / HTTP/1.1", b"\x15\x03"] {
            assert_eq!(asked(bytes), Asked::Nothing);
        }
        assert_eq!(asked(&[]), Asked::Unknown);
        let endless = [22, 3, 3, 0xFF, 0xFF, 1, 0xFF, 0xFF, 0xFF].into_iter().chain([0; MAX_LEN]);
        assert_eq!(asked(&endless.collect::<Vec<_>>()), Asked::Nothing);
    }

    proptest! {
        #[test]
        fn no_bytes_do_harm(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            asked(&bytes);
            asked(&[&[22, 3, 3, 1, 0, 1, 0, 0, 0xFC][..], &bytes].concat());
        }
    }
}
