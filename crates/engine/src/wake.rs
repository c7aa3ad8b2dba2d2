//! Wakes an event loop in another thread: a byte in a socket that the event loop reads.

use std::io;

#[cfg(not(unix))]
pub use std::net::TcpStream as Wakes;
#[cfg(unix)]
pub use std::os::unix::net::UnixStream as Wakes;

/// Two connected sockets that never block: one to write, one for the event loop.
///
/// # Errors
/// The system has no sockets left.
pub(crate) fn pair() -> io::Result<(Wakes, Wakes)> {
    let (wake, wakes) = connected()?;
    wake.set_nonblocking(true)?;
    wakes.set_nonblocking(true)?;
    Ok((wake, wakes))
}

#[cfg(unix)]
fn connected() -> io::Result<(Wakes, Wakes)> {
    Wakes::pair()
}

/// Other systems have no pairs of sockets: a connection over the loopback interface.
#[cfg(not(unix))]
fn connected() -> io::Result<(Wakes, Wakes)> {
    let listener = std::net::TcpListener::bind((std::net::Ipv4Addr::LOCALHOST, 0))?;
    let wake = Wakes::connect(listener.local_addr()?)?;
    let own = wake.local_addr()?;
    loop {
        // Another program may have connected first.
        let (wakes, peer) = listener.accept()?;
        if peer == own {
            wake.set_nodelay(true)?;
            return Ok((wake, wakes));
        }
    }
}
