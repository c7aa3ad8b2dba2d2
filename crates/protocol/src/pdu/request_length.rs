//! How long a request is by its function, and which other lengths a device may get.

/// Whether a server on a serial line reads this PDU as exactly one request. If a PDU of a standard function
/// is too long, the server takes the excess bytes as the start of another request. The length of other
/// functions is unknown: returns true.
///
/// ```
/// use holdfast_protocol::pdu::is_one_request;
///
/// assert!(is_one_request(&[3, 0, 5, 0, 1]));
/// assert!(!is_one_request(&[3, 0, 5, 0, 1, 0x94, 0x0B, 1, 6, 0, 5, 0xBE, 0xEF]));
/// assert!(!is_one_request(&[16, 0, 5, 0, 1, 2, 0xBE]));
/// assert!(is_one_request(&[66, 1, 2, 3]));
/// ```
pub fn is_one_request(pdu: &[u8]) -> bool {
    let Some((function_code, data)) = pdu.split_first() else { return false };
    match request_data_len(*function_code, data) {
        DataLen::Known(len) => data.len() == len,
        DataLen::Incomplete => false,
        DataLen::Unknown => true,
    }
}

/// Whether a device may get this PDU: a server on a serial line finds no other request in it. The PDU may be
/// two bytes longer than its function requires: some devices accept function 6 with a value of 32 bits, and
/// function 8 with two words. For all others these bytes can only be the CRC. The CRC of the frame is then 0,
/// and no request begins with that. The length of other functions is unknown: returns true.
///
/// ```
/// use holdfast_protocol::pdu::may_be_passed_on;
///
/// assert!(may_be_passed_on(&[6, 0, 5, 0, 1, 0xE2, 0x40]));
/// assert!(!may_be_passed_on(&[6, 0, 5, 0, 1, 0xE2, 0x40, 1]));
/// assert!(!may_be_passed_on(&[3, 0, 5, 0, 1, 0x94, 0x0B, 1, 6, 0, 5, 0xBE, 0xEF]));
/// assert!(!may_be_passed_on(&[6, 0, 5, 0]));
/// ```
pub fn may_be_passed_on(pdu: &[u8]) -> bool {
    is_one_request(pdu)
        || pdu.len().checked_sub(2).is_some_and(|shorter| is_one_request(&pdu[..shorter]))
}

pub(crate) enum DataLen {
    Known(usize),
    /// The length is in a later byte.
    Incomplete,
    Unknown,
}

/// Returns the length of the data between function code and CRC (V1.1b3, 6).
pub(crate) fn request_data_len(function_code: u8, data: &[u8]) -> DataLen {
    let counted = |at: usize| {
        data.get(at)
            .map_or(DataLen::Incomplete, |count| DataLen::Known(at + 1 + usize::from(*count)))
    };
    match function_code {
        1..=6 | 8 => DataLen::Known(4),
        7 | 11 | 12 | 17 => DataLen::Known(0),
        15 | 16 => counted(4),
        20 | 21 => counted(0),
        22 => DataLen::Known(6),
        23 => counted(8),
        24 => DataLen::Known(2),
        43 => match data.first() {
            None => DataLen::Incomplete,
            Some(14) => DataLen::Known(3),
            Some(_) => DataLen::Unknown,
        },
        _ => DataLen::Unknown,
    }
}
