//! Settings of a serial line, for clients and listeners.

use std::io;
use std::time::Duration;

use serial2_tokio::rs4xx::Rs485Config;
use serial2_tokio::{CharSize, FlowControl, Parity, SerialPort, Settings, StopBits};

/// Above 19,200 baud, the silence between RTU frames is constant (Serial Line V1.02, 2.5.1.1).
const FAST: (u32, Duration) = (19_200, Duration::from_micros(1_750));

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

impl SerialLine {
    /// Opens the device. Must be called in the context of a runtime.
    pub(crate) fn open(&self) -> io::Result<SerialPort> {
        let port = SerialPort::open(&self.device, |settings: Settings| self.set(settings))?;
        self.set_direction(|mode| set_mode_of_tokio(&port, mode))?;
        Ok(port)
    }

    /// Opens the device for blocking calls.
    pub(crate) fn open_blocking(&self) -> io::Result<serial2::SerialPort> {
        let set = |settings: Settings| self.set(settings);
        let port = serial2::SerialPort::open(&self.device, set)?;
        self.set_direction(|mode| set_mode(&port, mode))?;
        Ok(port)
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
        let device = std::fs::canonicalize(&self.device);
        device.is_ok_and(|device| device.starts_with("/dev/pts"))
    }

    /// The silence that ends an RTU frame: 3.5 characters by default.
    pub(crate) fn silence(&self) -> Duration {
        let (fast, shortest) = FAST;
        match self.mode {
            LineMode::Rtu { silence: Some(silence) } => silence,
            _ if self.baud > fast => shortest,
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
