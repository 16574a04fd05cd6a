//! How the bytes of a message are laid out, beside its type (DDS-XTypes 1.3, 7.4 and 7.6.3.1.2; RTPS 2.5, 10.2).

/// Bytes before the body: representation and options.
pub(crate) const ENCAPSULATION_BYTES: usize = 4;
/// Bytes that a payload may be filled up with.
pub(crate) const PADDING_BYTES_MAX: usize = 3;

/// How a payload is written. The default is what ROS 2 vendors write today: CDR of version 1, little endian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Encoding {
    /// The order of the bytes of a number.
    pub order: ByteOrder,
    /// The version of CDR.
    pub version: CdrVersion,
    /// How wide a unit of a `wstring` is.
    pub wide: WideUnit,
    /// Whether it is filled up to a multiple of four bytes.
    pub padding: Padding,
}

/// The order of the bytes of a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ByteOrder {
    /// The least first.
    #[default]
    Little,
    /// The least last.
    Big,
}

/// A version of CDR.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CdrVersion {
    /// XCDR1, plain.
    #[default]
    One,
    /// XCDR2, plain: what has 8 bytes is aligned to 4, and collections of what is no primitive say their size.
    Two,
    /// XCDR2, where structures say their size as well, and may end early or go on.
    TwoDelimited,
}

/// Bytes of a unit of a `wstring` in version 1, which vendors disagree about.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WideUnit {
    /// Two, as UTF-16 has it.
    #[default]
    Two,
    /// Four, which Fast CDR 1 and RMWs of its time wrote.
    Four,
}

/// Zeros behind the body, up to a multiple of four bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Padding {
    /// None, as Fast DDS writes it.
    #[default]
    None,
    /// There, and nobody says how many, as `rmw_cyclonedds_cpp` writes it.
    Silent,
    /// There, and the lowest two bits of the options say how many, as Cyclone DDS writes it.
    Said,
}

impl Encoding {
    /// By the id of a representation; `None` for those that ROS 2 does not use.
    pub(crate) fn from_id(id: u16) -> Option<Self> {
        let version = match id {
            0x0000 | 0x0001 => CdrVersion::One,
            0x0006 | 0x0007 => CdrVersion::Two,
            0x0008 | 0x0009 => CdrVersion::TwoDelimited,
            _ => return None,
        };
        let order = if id & 1 == 1 { ByteOrder::Little } else { ByteOrder::Big };
        Some(Self { order, version, ..Self::default() })
    }

    /// The id of the representation, as the header has it.
    pub(crate) fn id(self) -> u16 {
        let version = match self.version {
            CdrVersion::One => 0x0000,
            CdrVersion::Two => 0x0006,
            CdrVersion::TwoDelimited => 0x0008,
        };
        version | u16::from(self.is_little())
    }

    pub(crate) fn is_little(self) -> bool {
        self.order == ByteOrder::Little
    }

    pub(crate) fn is_second(self) -> bool {
        self.version != CdrVersion::One
    }

    pub(crate) fn is_delimited(self) -> bool {
        self.version == CdrVersion::TwoDelimited
    }

    /// What a number of so many bytes is aligned to.
    pub(crate) fn alignment(self, bytes: usize) -> usize {
        if self.is_second() { bytes.min(4) } else { bytes }
    }

    /// Bytes of a unit of a `wstring`.
    pub(crate) fn wide_bytes(self) -> usize {
        if self.wide == WideUnit::Four && !self.is_second() { 4 } else { 2 }
    }
}
