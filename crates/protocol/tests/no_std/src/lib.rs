//! Answers an RTU frame, as the firmware of a device would.

#![no_std]

use core::panic::PanicInfo;

use holdfast_protocol::frame::rtu;
use holdfast_protocol::pdu::{self, ExceptionCode, Request, pack_registers, reply};
use holdfast_protocol::raw_ingest::Format;

#[panic_handler]
fn panicked(_: &PanicInfo<'_>) -> ! {
    loop {}
}

/// Answers a request of `len` bytes in `frame`. Returns the length of the reply in `frame`, 0 when
/// there is none.
#[unsafe(no_mangle)]
pub extern "C" fn answer(frame: &mut [u8; rtu::MAX_LEN], len: usize) -> usize {
    let Some(Ok((unit_id, request))) = frame.get(..len).map(rtu::decode) else {
        return 0;
    };
    let mut out = [0; pdu::MAX_LEN];
    let len = serve(request, &mut out)
        .unwrap_or_else(|code| reply::exception(request[0], code, &mut out));
    rtu::encode(unit_id, &out[..len], frame).unwrap_or(0)
}

fn serve(request: &[u8], out: &mut pdu::Buffer) -> Result<usize, ExceptionCode> {
    const REGISTERS: [u16; 3] = [10, 20, 30];
    match Request::parse(request)? {
        Request::ReadInputRegisters(range) => {
            let found = REGISTERS.get(range.indices()).ok_or(ExceptionCode::IllegalDataAddress)?;
            let (room, len) = reply::read_input_registers(range, out);
            pack_registers(found, room);
            Ok(len)
        }
        _ => Err(ExceptionCode::IllegalFunction),
    }
}

/// Whether a Raw Ingest packet is complete and its CRC is right.
#[unsafe(no_mangle)]
pub extern "C" fn check(packet: &[u8; 64], len: usize) -> bool {
    let format = Format::Crc { required: true };
    let packet = packet.get(..len).unwrap_or_default();
    let header = format.header(packet).ok().flatten();
    header.is_some_and(|header| format.payload(&header, packet).is_ok())
}

/// The allocator that the feature `alloc` requires.
#[cfg(feature = "alloc")]
mod heap {
    extern crate alloc;

    use core::alloc::{GlobalAlloc, Layout};

    use alloc::boxed::Box;
    use holdfast_protocol::pdu::identification::Objects;

    struct NoMemory;

    // SAFETY: no memory is ever handed out.
    unsafe impl GlobalAlloc for NoMemory {
        unsafe fn alloc(&self, _: Layout) -> *mut u8 {
            core::ptr::null_mut()
        }

        unsafe fn dealloc(&self, _: *mut u8, _: Layout) {}
    }

    #[global_allocator]
    static ALLOCATOR: NoMemory = NoMemory;

    /// Whether objects with empty values are valid.
    #[unsafe(no_mangle)]
    pub extern "C" fn identify() -> bool {
        Objects::new([0, 1, 2].map(|id| (id, Box::default()))).is_ok()
    }
}
