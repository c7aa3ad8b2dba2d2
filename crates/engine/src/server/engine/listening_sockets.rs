//! The sockets of listeners: opened, or taken over from listeners that a reload ends.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use socket2::{SockRef, Socket};
use tokio::net::{TcpListener, UdpSocket};

use crate::server::connections::listener::{bind_tcp, bind_udp};
use crate::server::transports::udp::Datagrams;

/// The kind of a socket that listens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SocketKind {
    Tcp,
    Udp,
}

impl SocketKind {
    pub const fn name(self) -> &'static str {
        match self {
            SocketKind::Tcp => "tcp",
            SocketKind::Udp => "udp",
        }
    }
}

/// The socket of a running listener.
pub(super) struct ListeningSocket {
    pub(super) kind: SocketKind,
    pub(super) address: SocketAddr,
    /// Copies it, unless the task of the listener has ended.
    copy: Box<dyn Fn() -> Option<Socket> + Send + Sync>,
}

/// Binds a socket, or takes over one that ends. Must be called in the context of a runtime.
pub(super) fn tcp(
    bind: SocketAddr,
    ending: &mut Vec<Arc<ListeningSocket>>,
) -> io::Result<(Arc<TcpListener>, ListeningSocket)> {
    let socket = match taken_over(ending, SocketKind::Tcp, bind) {
        Some(socket) => socket.into(),
        None => bind_tcp(bind)?,
    };
    let socket = Arc::new(TcpListener::from_std(socket)?);
    let (address, weak) = (socket.local_addr()?, Arc::downgrade(&socket));
    let copy = Box::new(move || SockRef::from(&*weak.upgrade()?).try_clone().ok());
    Ok((socket, ListeningSocket { kind: SocketKind::Tcp, address, copy }))
}

/// As `tcp`: two functions, because Windows has another trait for what both sockets are.
pub(super) fn udp(
    bind: SocketAddr,
    ending: &mut Vec<Arc<ListeningSocket>>,
) -> io::Result<(Datagrams, ListeningSocket)> {
    let socket = match taken_over(ending, SocketKind::Udp, bind) {
        Some(socket) => socket.into(),
        None => bind_udp(bind)?,
    };
    let socket = UdpSocket::from_std(socket)?;
    let address = socket.local_addr()?;
    let datagrams = Datagrams::new(socket)?;
    let weak = Arc::downgrade(&datagrams.socket);
    let copy = Box::new(move || SockRef::from(&*weak.upgrade()?).try_clone().ok());
    Ok((datagrams, ListeningSocket { kind: SocketKind::Udp, address, copy }))
}

/// Copies the ending socket with that address. Each is taken over once.
fn taken_over(
    ending: &mut Vec<Arc<ListeningSocket>>,
    kind: SocketKind,
    address: SocketAddr,
) -> Option<Socket> {
    let at = ending.iter().position(|each| each.address == address && each.kind == kind)?;
    (ending.remove(at).copy)()
}
