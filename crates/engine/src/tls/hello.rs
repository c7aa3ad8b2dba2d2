//! What a client asks for in its ClientHello, where rustls does not answer as clients need it: the
//! maximum fragment length (RFC 6066, 4) and the application protocol (ALPN, RFC 7301).
//!
//! * rustls neither reads nor answers the length. Without an answer, a client must not rely on it.
//!   But a client with little memory can read everything that it gets, if the server keeps to it.
//! * rustls refuses a client that offers other protocols only. Such a client is served without an
//!   answer about protocols, as by OpenSSL: it may speak the right one nevertheless.

/// The first byte of a record with handshake messages, and the length of its header.
const HANDSHAKE: u8 = 22;
pub(super) const RECORD_HEADER_LEN: usize = 5;

/// The type of a ClientHello, and the lengths of its version and random number.
const CLIENT_HELLO: u8 = 1;
const FIXED_LEN: usize = 2 + 32;

/// The types of the extensions.
const MAX_FRAGMENT_LENGTH: u16 = 1;
const ALPN: u16 = 16;

/// The most bytes that are searched. Clients with little memory send less.
const MAX_LEN: usize = 4 * 1024;

/// The lengths that can be asked for, by their codes from 1.
pub(super) const LENGTHS: [usize; 4] = [512, 1024, 2048, 4096];

/// A ClientHello without its header, as far as it is searched.
#[derive(Debug)]
pub(super) struct Hello(Vec<u8>);

impl Hello {
    /// Reads the first bytes of a client. `None`: more bytes are needed.
    pub(super) fn of(bytes: &[u8]) -> Option<Hello> {
        let (message, is_cut) = message(bytes);
        (!is_cut || bytes.len() >= MAX_LEN).then_some(Hello(message))
    }

    /// The longest fragment that the client asks for, as an index in [`LENGTHS`].
    pub(super) fn fragment_length(&self) -> Option<usize> {
        match self.extension(MAX_FRAGMENT_LENGTH)? {
            [code] => usize::from(*code).checked_sub(1).filter(|index| *index < LENGTHS.len()),
            _ => None,
        }
    }

    /// Whether the client offers protocols, but not this one.
    pub(super) fn offers_others_than(&self, protocol: &[u8]) -> bool {
        let offered = self.extension(ALPN).and_then(long);
        offered.is_some_and(|(mut offered, _)| {
            while let Some((name, rest)) = short(offered) {
                if name == protocol {
                    return false;
                }
                offered = rest;
            }
            true
        })
    }

    /// The content of an extension.
    fn extension(&self, sought: u16) -> Option<&[u8]> {
        let rest = self.0.get(FIXED_LEN..)?;
        let (_session_id, rest) = short(rest)?;
        let (_cipher_suites, rest) = long(rest)?;
        let (_compressions, rest) = short(rest)?;
        let (_len, mut extensions) = rest.split_at_checked(2)?;
        while let [high, low, rest @ ..] = extensions {
            let (content, rest) = long(rest)?;
            if u16::from_be_bytes([*high, *low]) == sought {
                return Some(content);
            }
            extensions = rest;
        }
        None
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

    const HTTP: &[u8] = b"http/1.1";

    /// A ClientHello with such an extension, in records of at most `record` bytes.
    fn hello(extension: Option<(u8, &[u8])>, record: usize) -> Vec<u8> {
        let mut extensions = vec![0, 23, 0, 0];
        if let Some((kind, content)) = extension {
            extensions.extend([0, kind, 0, content.len() as u8]);
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
    fn a_length_is_found_once_the_message_has_arrived() {
        for record in [1, 7, 200] {
            for (content, expected) in [
                (Some(&[1][..]), Some(0)),
                (Some(&[4]), Some(3)),
                (Some(&[0]), None),
                (Some(&[5]), None),
                (Some(&[1, 1]), None),
                (Some(&[]), None),
                (None, None),
            ] {
                let bytes = hello(content.map(|content| (1, content)), record);
                assert_eq!(Hello::of(&bytes).unwrap().fragment_length(), expected);
                for cut in 0..bytes.len() {
                    assert!(Hello::of(&bytes[..cut]).is_none(), "cut at {cut}");
                }
            }
        }
    }

    #[test]
    fn only_a_client_that_offers_protocols_can_offer_others() {
        for (offered, is_other) in [
            (None, false),
            (Some(&b"\0\x0c\x02h2\x08http/1.1"[..]), false),
            (Some(b"\0\x09\x08http/1.1"), false),
            (Some(b"\0\x03\x02h2"), true),
            (Some(b"\0\x09\x08http/1.0"), true),
            (Some(b"\0\x03\x02h"), false),
            (Some(b""), false),
        ] {
            let bytes = hello(offered.map(|content| (16, content)), 50);
            let hello = Hello::of(&bytes).unwrap();
            assert_eq!(hello.offers_others_than(HTTP), is_other, "{offered:?}");
        }
    }

    #[test]
    fn other_bytes_ask_for_nothing() {
        let endless = [22, 3, 3, 0xFF, 0xFF, 1, 0xFF, 0xFF, 0xFF].into_iter().chain([0; MAX_LEN]);
        for bytes in [
            &b"\0\x01\0\0\0\x06\x01\x03\0\0\0\x01"[..],
            b"GET / HTTP/1.1",
            b"\x15\x03",
            &endless.collect::<Vec<_>>(),
        ] {
            let hello = Hello::of(bytes).unwrap();
            assert_eq!(hello.fragment_length(), None);
            assert!(!hello.offers_others_than(HTTP));
        }
        assert!(Hello::of(&[]).is_none());
    }

    proptest! {
        #[test]
        fn no_bytes_do_harm(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
            for bytes in [&bytes, &[&[22, 3, 3, 1, 0, 1, 0, 0, 0xFC][..], &bytes].concat()] {
                if let Some(hello) = Hello::of(bytes) {
                    hello.fragment_length();
                    hello.offers_others_than(HTTP);
                }
            }
        }
    }
}
