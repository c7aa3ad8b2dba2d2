//! Tests that the outcome of received bytes does not depend on how they were cut.

use std::fmt::Debug;

/// Feeds each case whole, cut in two at every byte, byte by byte, and in these ways joined with the next
/// case. `outcome` receives the pieces of a stream.
pub(in crate::server) fn assert_same_outcome<O: PartialEq + Debug>(
    cases: &[Vec<u8>],
    outcome: impl Fn(&[&[u8]]) -> O,
) {
    for (number, case) in cases.iter().enumerate() {
        let next = &cases[(number + 1) % cases.len()];
        for stream in [case.clone(), [&case[..], next].concat()] {
            let whole = outcome(&[&stream]);
            for cut in 1..stream.len() {
                let halves = outcome(&[&stream[..cut], &stream[cut..]]);
                assert_eq!(halves, whole, "case {number}, {stream:02x?}, cut at {cut}");
            }
            let bytes: Vec<&[u8]> = stream.chunks(1).collect();
            assert_eq!(outcome(&bytes), whole, "case {number}, {stream:02x?}, byte by byte");
        }
    }
}
