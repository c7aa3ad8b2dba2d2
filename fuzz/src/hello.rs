//! The first bytes of a TLS client: [lengths of the records] a ClientHello, or bytes as they are.

/// The most bytes that are needed.
const MAX_LEN: usize = 4 * 1024;
const HTTP: &[u8] = b"http/1.1";

/// What the client asks for does not change with more bytes, nor with the records that its message is cut into.
/// So many bytes always suffice.
pub fn check(data: &[u8]) {
    let (lengths, message) = crate::counted(data);
    let whole = asked(message);
    for end in (0..message.len()).step_by(message.len() / 32 + 1) {
        let before = asked(&message[..end]);
        assert!(before.is_none() || before == whole || end >= MAX_LEN, "cut at {end}");
    }
    assert!(whole.is_some() || message.len() < MAX_LEN);
    // The same message in one record, and in many.
    let message = &message[..message.len().min(2048)];
    let one = asked(&records(&[message]));
    let many = asked(&records(&crate::pieces(lengths, message)));
    if let (Some(one), Some(many)) = (one, many) {
        assert_eq!(one, many, "records of {lengths:?}");
    }
}

fn records(parts: &[&[u8]]) -> Vec<u8> {
    let record =
        |part: &&[u8]| [&[22, 3, 1], &(part.len() as u16).to_be_bytes()[..], part].concat();
    parts.iter().flat_map(record).collect()
}

/// The longest fragment, and whether other protocols are offered.
fn asked(bytes: &[u8]) -> Option<(Option<usize>, bool)> {
    let hello = crate::tls_hello::Hello::of(bytes)?;
    let length = hello.fragment_length();
    assert!(length.is_none_or(|length| length < crate::tls_hello::LENGTHS.len()));
    Some((length, hello.offers_others_than(HTTP)))
}
