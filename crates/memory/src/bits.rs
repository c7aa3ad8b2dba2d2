//! Copies ranges of packed bits (least significant bit first) out of an area and into it.

/// Copies `count` bits of `area`, from bit `offset`, to the start of `out`. Unused bits of the last
/// byte of `out` become 0. `out` has `count.div_ceil(8)` bytes; `area` has the whole range.
pub fn copy_out(area: &[u8], offset: usize, count: usize, out: &mut [u8]) {
    debug_assert_eq!(out.len(), count.div_ceil(8));
    debug_assert!(offset + count <= area.len() * 8);
    let first = offset / 8;
    let shift = offset % 8;
    if shift == 0 {
        out.copy_from_slice(&area[first..first + out.len()]);
    } else {
        for (index, byte) in out.iter_mut().enumerate() {
            let low = area[first + index] >> shift;
            let high = area.get(first + index + 1).map_or(0, |next| next << (8 - shift));
            *byte = low | high;
        }
    }
    if let (Some(last), used @ 1..) = (out.last_mut(), count % 8) {
        *last &= low_bits(used);
    }
}

/// Copies the first `count` bits of `bits` into `area`, from bit `offset`. Bits beyond `count` in
/// the last byte of `bits` are ignored. `bits` has `count.div_ceil(8)` bytes; `area` has the whole
/// range.
pub fn copy_in(area: &mut [u8], offset: usize, count: usize, bits: &[u8]) {
    debug_assert_eq!(bits.len(), count.div_ceil(8));
    debug_assert!(offset + count <= area.len() * 8);
    // One more byte would change bits after the range.
    assert!(bits.len() * 8 < count + 8);
    let first = offset / 8;
    let shift = offset % 8;
    for (index, &byte) in bits.iter().enumerate() {
        let valid = low_bits((count - index * 8).min(8));
        let mask = u16::from(valid) << shift;
        let value = u16::from(byte & valid) << shift;
        let [mask_low, mask_high] = mask.to_le_bytes();
        let [value_low, value_high] = value.to_le_bytes();
        let target = &mut area[first + index];
        *target = (*target & !mask_low) | value_low;
        if mask_high != 0 {
            let target = &mut area[first + index + 1];
            *target = (*target & !mask_high) | value_high;
        }
    }
}

/// The bit at `offset`.
pub fn get(area: &[u8], offset: usize) -> bool {
    area[offset / 8] >> (offset % 8) & 1 == 1
}

/// A byte with its `count` (0 to 8) low bits set.
const fn low_bits(count: usize) -> u8 {
    if count >= 8 { 0xFF } else { (1 << count) - 1 }
}
