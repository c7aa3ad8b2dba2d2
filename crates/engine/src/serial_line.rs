//! Settings of a serial line, for clients and listeners.

#[cfg(unix)]
use std::collections::BTreeMap;
use std::io;
#[cfg(unix)]
use std::io::ErrorKind;
#[cfg(unix)]
use std::os::fd::OwnedFd;
#[cfg(unix)]
use std::path::PathBuf;
#[cfg(unix)]
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

#[cfg(unix)]
use rustix::fs::{FlockOperation, Mode, OFlags, Stat, flock, fstat, open, stat};
#[cfg(unix)]
use rustix::io::Errno;
use serial2_tokio::rs4xx::Rs485Config;
use serial2_tokio::{CharSize, FlowControl, Parity, SerialPort, Settings, StopBits};

/// Above this rate, the silence between RTU frames is constant (Serial Line V1.02, 2.5.1.1).
const FAST_BAUD: u32 = 19_200;
const SILENCE_WHEN_FAST: Duration = Duration::from_micros(1_750);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineParity {
    None,
    Even,
    Odd,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineMode {
    /// A silence ends a frame. `None` uses the silence of the standard.
    Rtu {
        silence: Option<Duration>,
    },
    Ascii,
}

/// Who switches an RS-485 line between sending and receiving.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LineDirection {
    /// The adapter, or the driver as it is set up.
    Adapter,
    /// The driver, by RTS: high while sending. Only on Linux.
    Rts,
    /// The driver, by RTS: low while sending. Only on Linux.
    RtsLow,
}

/// Settings of a serial line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialLine {
    pub device: String,
    pub baud: u32,
    pub parity: LineParity,
    pub stop_bits: u8,
    pub data_bits: u8,
    pub mode: LineMode,
    pub direction: LineDirection,
}

/// An open line. Programs that ask for its lock, as this one does, can't open it meanwhile: two masters would
/// take each other's replies.
#[derive(Debug)]
pub(crate) struct OpenLine<Port> {
    pub(crate) port: Port,
    device: String,
    lock: Lock,
}

impl<Port> OpenLine<Port> {
    /// Whether its name is that of another device now. A name that is gone says nothing.
    pub(crate) fn has_moved(&self) -> bool {
        is_another(&self.device, &self.lock)
    }
}

impl SerialLine {
    /// Opens the device. Must be called in the context of a runtime.
    pub(crate) fn open(&self) -> io::Result<OpenLine<SerialPort>> {
        let lock = lock(&self.device, User::Listener)?;
        let port = SerialPort::open(&self.device, |settings: Settings| self.set(settings))?;
        self.set_direction(|mode| set_mode_of_tokio(&port, mode))?;
        Ok(OpenLine { port, device: self.device.clone(), lock })
    }

    /// Opens the device for blocking calls.
    pub(crate) fn open_blocking(&self) -> io::Result<OpenLine<serial2::SerialPort>> {
        let lock = lock(&self.device, User::Client)?;
        let set = |settings: Settings| self.set(settings);
        let port = serial2::SerialPort::open(&self.device, set)?;
        // What came before is no reply, and would be judged as one that nobody asked for.
        port.discard_input_buffer()?;
        self.set_direction(|mode| set_mode(&port, mode))?;
        Ok(OpenLine { port, device: self.device.clone(), lock })
    }

    /// Lets the driver switch the direction of the line.
    fn set_direction(&self, set: impl FnOnce(Rs485Config) -> io::Result<()>) -> io::Result<()> {
        let mut mode = Rs485Config::new();
        match self.direction {
            LineDirection::Adapter => return Ok(()),
            LineDirection::Rts => {}
            LineDirection::RtsLow => mode.set_invert_rts(true),
        }
        set(mode).map_err(|error| {
            let what = "the driver can't switch an RS-485 line by RTS";
            io::Error::new(error.kind(), format!("{what}: {error}"))
        })
    }

    fn set(&self, mut settings: Settings) -> io::Result<Settings> {
        settings.set_raw();
        settings.set_baud_rate(self.baud)?;
        settings.set_stop_bits(if self.stop_bits == 2 { StopBits::Two } else { StopBits::One });
        settings.set_flow_control(FlowControl::None);
        if !self.is_pseudo_terminal() {
            let seven = self.data_bits == 7;
            settings.set_char_size(if seven { CharSize::Bits7 } else { CharSize::Bits8 });
            settings.set_parity(match self.parity {
                LineParity::None => Parity::None,
                LineParity::Even => Parity::Even,
                LineParity::Odd => Parity::Odd,
            });
        }
        Ok(settings)
    }

    /// Linux refuses to set character size and parity of a pseudo terminal.
    fn is_pseudo_terminal(&self) -> bool {
        let path = std::fs::canonicalize(&self.device);
        path.is_ok_and(|path| path.starts_with("/dev/pts"))
    }

    /// The silence that ends an RTU frame: 3.5 characters by default.
    pub(crate) fn silence(&self) -> Duration {
        match self.mode {
            LineMode::Rtu { silence: Some(silence) } => silence,
            _ if self.baud > FAST_BAUD => SILENCE_WHEN_FAST,
            _ => self.character().mul_f64(3.5),
        }
    }

    /// The time of one character.
    pub(crate) fn character(&self) -> Duration {
        let parity = u32::from(self.parity != LineParity::None);
        let bits = 1 + u32::from(self.data_bits) + parity + u32::from(self.stop_bits);
        Duration::from_secs_f64(f64::from(bits) / f64::from(self.baud))
    }
}

#[cfg(unix)]
type Lock = Arc<HeldLock>;

/// Ends with the process that took it, not with a child that has inherited the file.
#[cfg(unix)]
#[derive(Debug)]
struct HeldLock {
    file: OwnedFd,
    user: User,
    of_process: u32,
}

#[cfg(unix)]
impl Drop for HeldLock {
    fn drop(&mut self) {
        if self.of_process == std::process::id() {
            let _ = flock(&self.file, FlockOperation::Unlock);
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum User {
    /// A reload opens its line before it closes it.
    Listener,
    Client,
}

/// Locks a line. Within this process, only a listener may open it again, while another one has it.
#[cfg(unix)]
fn lock(device: &str, user: User) -> io::Result<Lock> {
    static HELD: Mutex<BTreeMap<PathBuf, Weak<HeldLock>>> = Mutex::new(BTreeMap::new());
    let path = std::fs::canonicalize(device)?;
    let mut held = holdfast_runtime::lock(&HELD);
    held.retain(|_, lock| lock.strong_count() > 0);
    let found = stat(&path)?;
    let is_same = |lock: &Lock| {
        lock.of_process == std::process::id()
            && fstat(&lock.file).is_ok_and(|of| is_device(&of, &found))
    };
    if let Some(lock) = held.get(&path).and_then(Weak::upgrade).filter(is_same) {
        if (lock.user, user) != (User::Listener, User::Listener) {
            let what = "another client or listener of this program uses the line";
            return Err(io::Error::new(ErrorKind::ResourceBusy, what));
        }
        return Ok(lock);
    }
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = open(&path, flags, Mode::empty())?;
    flock(&file, FlockOperation::NonBlockingLockExclusive).map_err(|error| match error {
        Errno::WOULDBLOCK => {
            io::Error::new(ErrorKind::ResourceBusy, "another program uses the line")
        }
        other => other.into(),
    })?;
    let lock = Arc::new(HeldLock { file, user, of_process: std::process::id() });
    held.insert(path, Arc::downgrade(&lock));
    Ok(lock)
}

/// A device that is plugged in again is another one.
#[cfg(unix)]
fn is_device(one: &Stat, other: &Stat) -> bool {
    (one.st_dev, one.st_ino, one.st_rdev) == (other.st_dev, other.st_ino, other.st_rdev)
}

#[cfg(unix)]
fn is_another(device: &str, lock: &Lock) -> bool {
    let (named, open) = (stat(device), fstat(&lock.file));
    named.is_ok_and(|named| open.is_ok_and(|open| !is_device(&open, &named)))
}

/// Windows lets nobody open a line twice.
#[cfg(not(unix))]
type Lock = ();

#[cfg(not(unix))]
fn is_another(_device: &str, _lock: &Lock) -> bool {
    false
}

#[cfg(not(unix))]
fn lock(_device: &str, _user: User) -> io::Result<Lock> {
    Ok(())
}

#[cfg(target_os = "linux")]
fn set_mode(port: &serial2::SerialPort, mode: Rs485Config) -> io::Result<()> {
    port.set_rs4xx_mode(mode)
}

#[cfg(target_os = "linux")]
fn set_mode_of_tokio(port: &SerialPort, mode: Rs485Config) -> io::Result<()> {
    port.set_rs4xx_mode(mode)
}

#[cfg(not(target_os = "linux"))]
fn set_mode(_: &serial2::SerialPort, _: Rs485Config) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(not(target_os = "linux"))]
fn set_mode_of_tokio(_: &SerialPort, _: Rs485Config) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(baud: u32, parity: LineParity, stop_bits: u8) -> SerialLine {
        SerialLine {
            device: String::new(),
            baud,
            parity,
            stop_bits,
            data_bits: 8,
            mode: LineMode::Rtu { silence: None },
            direction: LineDirection::Adapter,
        }
    }

    #[test]
    fn the_silence_between_frames_is_that_of_the_standard() {
        let micros = |baud, parity, stop| line(baud, parity, stop).silence().as_micros();
        // 3.5 characters of 11 bits, and of 10 bits.
        assert_eq!(micros(1_200, LineParity::Even, 1), 32_083);
        assert_eq!(micros(9_600, LineParity::Odd, 1), 4_010);
        assert_eq!(micros(9_600, LineParity::None, 2), 4_010);
        assert_eq!(micros(9_600, LineParity::None, 1), 3_645);
        assert_eq!(micros(19_200, LineParity::Even, 1), 2_005);
        for fast in [19_201, 38_400, 115_200] {
            assert_eq!(micros(fast, LineParity::Even, 1), 1_750);
        }
    }

    /// A pseudo-terminal has settings to start from, although it would not take these.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_line_has_the_characters_of_its_settings() {
        let port = serial2::SerialPort::open("/dev/ptmx", serial2::KeepSettings).unwrap();
        let parities = [
            (LineParity::None, Parity::None),
            (LineParity::Even, Parity::Even),
            (LineParity::Odd, Parity::Odd),
        ];
        for (parity, set) in parities {
            for (stop_bits, stops) in [(1, StopBits::One), (2, StopBits::Two)] {
                for (data_bits, size) in [(7, CharSize::Bits7), (8, CharSize::Bits8)] {
                    let line = SerialLine { data_bits, ..line(9_600, parity, stop_bits) };
                    let settings = line.set(port.get_configuration().unwrap()).unwrap();
                    assert_eq!(settings.get_parity().unwrap(), set);
                    assert_eq!(settings.get_stop_bits().unwrap(), stops);
                    assert_eq!(settings.get_char_size().unwrap(), size);
                    assert_eq!(settings.get_baud_rate().unwrap(), 9_600);
                }
            }
        }
    }
}
