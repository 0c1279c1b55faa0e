//! Defines the interface of every rig, which transports bytes to a target and back, and the errors
//! and planned faults of a target.

use crate::crash_report::CrashReport;
use crate::rejected_frame::RejectedFrame;
use crate::symbols::CodeLocation;
use platebench_model::metrics::{EnablePin, OutputRead};
use platebench_model::record::{Transport, UnmodelledInstance};
use platebench_model::scenario::ChipFaultKind;
use platebench_wire::Packet;
use std::fmt;
use std::ops::DerefMut;
use std::time::{Duration, Instant};

pub type BoxedLink = Box<dyn Link>;

#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    #[error("the link to the controller is lost: {0}")]
    Disconnected(String),
    /// The controller is a program that ended by itself. Contains its exit status or signal.
    #[error("the program of the controller ended before 0 V was confirmed: {0}")]
    Ended(String),
    #[error("{0}")]
    Target(Box<TargetError>),
    /// A target in this process answers the sample of this trial time otherwise if it passes as bytes.
    #[error(
        "the bench has a defect, please report it: the sample {} µs after the start of the trial has another answer if \
         it passes as bytes",
        .0.as_micros()
    )]
    BytesDiffer(Duration),
}

/// Clock and reliability of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LinkKind {
    /// The target runs in simulated time. No byte is lost.
    #[default]
    Simulated,
    /// The target runs in wall time. No byte is lost.
    Lossless,
    /// The target runs in wall time. Noise on the line may destroy bytes.
    Lossy,
    /// As [`Self::Lossy`]. A server may let other clients use the line, too.
    Network,
}

impl LinkKind {
    pub fn loses_bytes(self) -> bool {
        matches!(self, Self::Lossy | Self::Network)
    }
}

/// A line on which one thread sends and receives in real time.
pub trait RealTimeLine: Send {
    /// Call it before a trial on the thread of the trial loop, because a thread that reads the line
    /// inherits the scheduling class.
    fn start(&mut self) -> Result<(), LinkError> {
        Ok(())
    }

    /// Returns the time of the line's clock. Only a line in simulated time has a clock of its own.
    fn now(&mut self) -> Instant {
        Instant::now()
    }

    /// Returns at once. Drops the bytes that a full line does not accept.
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError>;

    /// Appends bytes that arrive by `until` and returns their arrival; `None` on time-out. Takes
    /// bytes that already wait even if `until` is past. Does not allocate if `bytes` has capacity.
    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError>;
}

/// Access to an emulated chip: measurements, pins, RTT text and faults.
pub trait Chip {
    /// Instructions that the chip ran from the first bit of the last [`Link::exchange`] to the last
    /// bit of its answer, but at most those of [`Chip::computing_time`], because firmware that polls
    /// also runs during the transmission; `None` without an answer.
    fn instruction_count(&self) -> Option<u64>;

    /// Bits per second of the line.
    fn baud(&self) -> u32;

    /// Time that the chip computed for the last [`Link::exchange`] with an answer, without the
    /// transmission.
    fn computing_time(&self) -> Option<Duration>;

    /// RTT text of the firmware in this trial; `None` without text or without an RTT block.
    fn firmware_output(&self) -> Option<String>;

    /// When the bench read the parts of the text; `None` without an RTT block or with frames.
    fn firmware_output_reads(&self) -> Option<Vec<OutputRead>>;

    /// Frames of the crate `defmt` that the firmware wrote by RTT in this trial instead of text.
    fn defmt_frames(&self) -> Option<Vec<u8>>;

    /// Accesses since power-on to instances of the chip without a model.
    fn unmodelled_instances(&self) -> Vec<UnmodelledInstance>;

    /// True if the image is marked as hard float and all registers of the FPU are 0.
    fn is_fpu_unused(&self) -> bool;

    /// True if the pin PB0, which enables the amplifier, is high. `None` if it was not high yet in
    /// this trial.
    fn amplifier_enabled(&mut self) -> Option<bool>;

    /// The same pin over the whole trial.
    fn enable_pin(&self) -> EnablePin;

    /// Sets how messages pass from the next restart on. Call it before the trial's configuration.
    fn set_transport(&mut self, transport: Transport);

    /// How the messages of this trial passed.
    fn transport(&self) -> Transport;

    /// With [`Transport::BlocksAndWords`], plays all exchanges since the restart again as words and
    /// continues from there. Fails if an answer, a delay or an instruction count differs.
    fn check_transport(&mut self) -> Result<(), LinkError>;

    /// Sets the faults that act from the next restart on. Call it before the trial's configuration.
    fn set_faults(&mut self, plan: &ChipFaultPlan) -> Result<(), ChipFaultError>;
}

/// In all methods, `now` is the time since the start of the trial.
pub trait Link: Send {
    /// Sends `bytes` and appends the answer, up to its end or the time-out; a missing answer is no
    /// error. Returns the time from the request to the end of the answer; zero without an answer
    /// and on the hosted rig.
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError>;

    /// Advances the target's time to `now` and appends the bytes that the target sends until then.
    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError>;

    /// Answer of a target in this process to the sample in `packet`, without the bytes of both. With
    /// `is_checked`, fails if the bytes give another answer. `None` if the link transports bytes only.
    fn answer_sample(
        &mut self,
        _now: Duration,
        _packet: &Packet,
        _is_checked: bool,
    ) -> Option<Result<Packet, LinkError>> {
        None
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Simulated
    }

    /// Restarts the target and sets trial time to zero. Returns false if the link cannot.
    fn restart(&mut self) -> Result<bool, LinkError> {
        Ok(false)
    }

    /// Starts another trial without a restart of the target. The next `now` counts from zero.
    fn continue_trial(&mut self) {}

    /// Access to the chip, if the link emulates it.
    fn chip(&mut self) -> Option<&mut dyn Chip> {
        None
    }

    /// Line for a trial's samples in real time, if the link has one. Other messages may use
    /// [`Link::exchange`].
    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        None
    }
}

impl<P: DerefMut<Target: Link> + Send> Link for P {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        (**self).exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        (**self).advance_to(now, received)
    }

    fn answer_sample(&mut self, now: Duration, packet: &Packet, is_checked: bool) -> Option<Result<Packet, LinkError>> {
        (**self).answer_sample(now, packet, is_checked)
    }

    fn kind(&self) -> LinkKind {
        (**self).kind()
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        (**self).restart()
    }

    fn continue_trial(&mut self) {
        (**self).continue_trial();
    }

    fn chip(&mut self) -> Option<&mut dyn Chip> {
        (**self).chip()
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        (**self).real_time_line()
    }
}

/// Planned fault of the chip with its instant and its random choice.
#[derive(Debug, Clone, PartialEq)]
pub struct DatedChipFault {
    /// Time since the start of the trial.
    pub at: Duration,
    pub kind: ChipFaultKind,
    /// A bit flip changes bit `draw` modulo the number of bits.
    pub draw: u64,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct ChipFaultPlan {
    /// Sorted by time.
    pub faults: Vec<DatedChipFault>,
    /// The plate waits at most this long for an answer.
    pub answer_timeout: Duration,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ChipFaultError {
    #[error("only the emulated rig in lockstep can apply faults of the chip")]
    Unsupported,
    #[error("the firmware image has no variable `{0}` with a size; list them with `nm --size-sort --demangle`")]
    NoVariable(String),
    #[error("the fault needs {length} bytes at {start:#010x}, which are not RAM of the emulated STM32F427")]
    NoRam { start: u32, length: u32 },
}

/// Error of firmware on an emulated board or on a board with a debug probe.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TargetError {
    #[error("{0}")]
    Trap(Box<CrashReport>),
    #[error("the processor locked up (a fault within a fault handler) at {0}")]
    Lockup(CodeLocation),
    #[error("the target reset itself ({cause}) {at_us} µs after power-on; it was at {place}")]
    Reset { cause: String, at_us: u64, place: CodeLocation },
    #[error("the emulated STM32F427 does not support this access by the firmware: {0}")]
    Unsupported(UnsupportedAccess),
    #[error("the firmware did not answer within {waited_us} µs after the message arrived; the processor is at {place}")]
    Silent { waited_us: u64, place: CodeLocation },
    #[error("{0}: {bodies}", bodies = .0.bodies())]
    RejectedAnswer(RejectedFrame),
    #[error(
        "the firmware did not answer the handshake on USART2 (PA2, PA3) within {waited_ms} ms after power-on; \
         it uses {}, and the processor is at {place}",
        if instances.is_empty() { "no peripheral".to_owned() } else { instances.join(", ") }
    )]
    NoHandshake { waited_ms: u64, instances: Vec<&'static str>, place: CodeLocation },
    #[error("the emulator failed: {0}")]
    Emulator(String),
}

impl TargetError {
    /// The error without instants and callers: equal for the same fault at the same place.
    pub fn cause(&self) -> String {
        match self {
            Self::Trap(crash) => crash.cause(),
            Self::Reset { cause, place, .. } => format!("the target reset itself ({cause}); it was at {place}"),
            Self::Silent { place, .. } => format!("the firmware did not answer; the processor is at {place}"),
            other => other.to_string(),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnsupportedAccess {
    /// Peripheral and register if they have names, and the kind of access.
    pub access: String,
    pub address: Option<u32>,
    pub place: Option<CodeLocation>,
}

impl fmt::Display for UnsupportedAccess {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.access)?;
        if let Some(address) = self.address {
            write!(formatter, ", address {address:#010x}")?;
        }
        self.place.as_ref().map_or(Ok(()), |place| write!(formatter, ", accessed from {place}"))
    }
}
