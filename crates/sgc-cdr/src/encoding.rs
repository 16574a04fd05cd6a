//! Encodings of a message's bytes, beside its type (DDS-XTypes 1.3, 7.4 and 7.6.3.1.2; RTPS 2.5, 10.2).

/// Bytes before the body: representation and options.
pub(crate) const ENCAPSULATION_BYTES: usize = 4;
/// Most padding bytes of a payload.
pub(crate) const PADDING_BYTES_MAX: usize = 3;

/// Encoding of a payload. The default is that of ROS 2 vendors today: CDR of version 1, little endian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Encoding {
    /// The order of the bytes of a number.
    pub order: ByteOrder,
    /// The version of CDR.
    pub version: CdrVersion,
    /// Width of a unit of a `wstring`.
    pub wide: WideUnit,
    /// Whether it is padded to a multiple of four bytes.
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
    /// XCDR2, plain: 8-byte values are aligned to 4, and collections of non-primitives carry their size.
    Two,
    /// XCDR2, where structures carry their size as well, and may end early or go on.
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
    /// Present without a count, as `rmw_cyclonedds_cpp` writes it.
    Silent,
    /// Present, counted in the lowest two bits of the options, as Cyclone DDS writes it.
    Said,
}

impl Encoding {
    /// Returns the encoding of a representation id; `None` for those that ROS 2 does not use.
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

    /// Returns the id of the representation in the header.
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

    /// Returns the alignment of a number of this many bytes.
    pub(crate) fn alignment(self, bytes: usize) -> usize {
        if self.is_second() { bytes.min(4) } else { bytes }
    }

    /// Returns the bytes of a unit of a `wstring`.
    pub(crate) fn wide_bytes(self) -> usize {
        if self.wide == WideUnit::Four && !self.is_second() { 4 } else { 2 }
    }
}
