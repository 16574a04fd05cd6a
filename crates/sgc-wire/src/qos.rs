//! DDS quality of service as it travels between nodes: the policies a far writer must mirror.
//!
//! Only the shape lives here. `sgc-ros` decides the QoS that a ROS 2 endpoint offers and that a reader may request of
//! it, `sgc-dds` converts it for a DDS implementation.

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};

/// Reliability of a DDS endpoint (DDS 1.4, 2.2.3.14).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Reliability {
    /// Samples may be lost.
    BestEffort,
    /// Samples are acknowledged and sent again.
    Reliable,
}

/// Durability of a DDS endpoint (DDS 1.4, 2.2.3.4). ROS 2 uses the first two.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Durability {
    /// Nothing is kept for late joiners.
    Volatile,
    /// The writer keeps its history for late joiners.
    TransientLocal,
    /// A durability service keeps samples; carried, not provided.
    Transient,
    /// Samples survive the system; carried, not provided.
    Persistent,
}

/// History of a DDS endpoint (DDS 1.4, 2.2.3.18).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum History {
    /// The newest `n` samples per instance, `n` ≥ 1.
    KeepLast(u32),
    /// All samples, within resource limits.
    KeepAll,
}

impl History {
    /// The history of a transient-local publisher that did not announce its depth: as deep as memory allows, until the
    /// depth is known. DDS has no deeper one (DDS 1.4, 2.2.3.18: a signed number).
    pub const UNSAID: Self = Self::KeepLast(i32::MAX as u32);

    /// Returns `true` if the depth was not announced and is not known.
    pub fn is_unsaid(self) -> bool {
        self == Self::UNSAID
    }
}

/// Liveliness kind (DDS 1.4, 2.2.3.11).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Liveliness {
    /// The middleware asserts it.
    Automatic,
    /// Any writer of the participant asserts it for all.
    ManualByParticipant,
    /// Each writer asserts its own.
    ManualByTopic,
}

/// Serialisations of samples (XTypes 1.3, 7.6.3.1): those that a reader takes, or the one that a writer offers. Never
/// empty; an endpoint without this policy has plain CDR.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Representations(u8);

impl Representations {
    /// Plain CDR, XCDR version 1: all that ROS 2's own types use.
    pub const XCDR1: Self = Self(1);
    /// XCDR version 2.
    pub const XCDR2: Self = Self(2);
    /// Both versions.
    pub const BOTH: Self = Self(3);

    /// Returns the union of both.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Returns the serialisation of a writer in place of several that together offer these: plain CDR, if it is among
    /// them.
    #[must_use]
    pub fn written(self) -> Self {
        if self == Self::XCDR2 { self } else { Self::XCDR1 }
    }

    /// Returns `true` if a reader that takes `other` understands a writer that offers this.
    pub fn meets(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }
}

impl Default for Representations {
    fn default() -> Self {
        Self::XCDR1
    }
}

impl std::fmt::Debug for Representations {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(["", "XCDR1", "XCDR2", "XCDR1 or XCDR2"][usize::from(self.0 & 3)])
    }
}

/// Quality of service of one endpoint. Durations are nanoseconds; `None` is infinite.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Qos {
    /// Reliability.
    pub reliability: Reliability,
    /// Durability.
    pub durability: Durability,
    /// History and depth.
    pub history: History,
    /// Deadline period in nanoseconds.
    pub deadline_ns: Option<u64>,
    /// Lifespan in nanoseconds.
    pub lifespan_ns: Option<u64>,
    /// Liveliness kind.
    pub liveliness: Liveliness,
    /// Liveliness lease duration in nanoseconds.
    pub lease_ns: Option<u64>,
    /// DDS partitions; empty is the default partition. At most [`Qos::PARTITIONS_MAX`].
    pub partitions: Vec<String>,
    /// Serialisations of its samples.
    pub representations: Representations,
}

impl Qos {
    /// Bound on partitions carried for one endpoint.
    pub const PARTITIONS_MAX: usize = 16;
    /// Bound on the length of one partition's name, bytes.
    pub const PARTITION_BYTES_MAX: usize = 256;

    /// Returns `true` if late joiners receive history.
    pub fn is_transient_local(&self) -> bool {
        self.durability >= Durability::TransientLocal
    }

    /// Returns `true` if samples are acknowledged.
    pub fn is_reliable(&self) -> bool {
        self.reliability == Reliability::Reliable
    }
}

/// The defaults of `rclcpp::QoS(10)`: reliable, volatile, keep last 10.
impl Default for Qos {
    fn default() -> Self {
        Self {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            history: History::KeepLast(10),
            deadline_ns: None,
            lifespan_ns: None,
            liveliness: Liveliness::Automatic,
            lease_ns: None,
            partitions: Vec::new(),
            representations: Representations::XCDR1,
        }
    }
}

impl Encode for Qos {
    fn encode(&self, w: &mut Writer) {
        w.u8(self.reliability as u8);
        w.u8(self.durability as u8);
        w.u32(match self.history {
            History::KeepAll => 0,
            History::KeepLast(n) => n.max(1),
        });
        w.u64(self.deadline_ns.unwrap_or(u64::MAX));
        w.u64(self.lifespan_ns.unwrap_or(u64::MAX));
        w.u8(self.liveliness as u8);
        w.u64(self.lease_ns.unwrap_or(u64::MAX));
        w.list(&self.partitions, |w, p| w.str(p));
        w.u8(self.representations.0);
    }
}

impl Decode for Qos {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let finite = |v: u64| (v != u64::MAX).then_some(v);
        Ok(Self {
            reliability: match r.u8()? {
                0 => Reliability::BestEffort,
                1 => Reliability::Reliable,
                v => return Err(DecodeError::value("reliability", v.into())),
            },
            durability: match r.u8()? {
                0 => Durability::Volatile,
                1 => Durability::TransientLocal,
                2 => Durability::Transient,
                3 => Durability::Persistent,
                v => return Err(DecodeError::value("durability", v.into())),
            },
            history: match r.u32()? {
                0 => History::KeepAll,
                n => History::KeepLast(n),
            },
            deadline_ns: finite(r.u64()?),
            lifespan_ns: finite(r.u64()?),
            liveliness: match r.u8()? {
                0 => Liveliness::Automatic,
                1 => Liveliness::ManualByParticipant,
                2 => Liveliness::ManualByTopic,
                v => return Err(DecodeError::value("liveliness", v.into())),
            },
            lease_ns: finite(r.u64()?),
            partitions: r.list("partitions", Self::PARTITIONS_MAX, |r| {
                r.str("partition", Self::PARTITION_BYTES_MAX)
            })?,
            representations: match r.u8()? {
                v @ 1..=3 => Representations(v),
                v => return Err(DecodeError::value("data representations", v.into())),
            },
        })
    }
}
