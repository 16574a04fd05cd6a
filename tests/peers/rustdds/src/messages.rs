//! The message types of the peers and the content of each message; the Rust counterpart of `../../py/messages.py`.
//! `../../README.md` specifies both. serde writes and reads CDR, as in `ros2-client`.

use serde::{Deserialize, Serialize, de::DeserializeOwned};

const BLOCK_BYTES: usize = 1 << 16;
const HEAD_BYTES: usize = 20;

/// splitmix64: the same bytes on all sides from one seed.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn take(&mut self, count: usize) -> Vec<u8> {
        let mut bytes: Vec<u8> = (0..count.div_ceil(8)).flat_map(|_| self.next().to_le_bytes()).collect();
        bytes.truncate(count);
        bytes
    }
}

/// The number and time inside a received message, and whether its content is intact.
pub struct Reading {
    pub seq: u64,
    pub stamp_ns: u64,
    pub intact: bool,
}

pub trait Message: Serialize + DeserializeOwned + Send + Sync + 'static {
    /// Package and name of the ROS type.
    const TYPE: (&'static str, &'static str);

    fn make(seq: u64, stamp_ns: u64, size: usize) -> Self;

    /// `None` if the message holds none.
    fn read(&self) -> Option<Reading>;
}

/// `seq=… t=… fill=…` of a text.
fn parse(text: &str) -> Option<(u64, u64, usize)> {
    let mut parts = text.split(' ');
    let seq = parts.next()?.strip_prefix("seq=")?.parse().ok()?;
    let stamp_ns = parts.next()?.strip_prefix("t=")?.parse().ok()?;
    Some((seq, stamp_ns, parts.next()?.strip_prefix("fill=")?.chars().count()))
}

fn filler_length(seq: u64, size: usize) -> usize {
    if size > 0 { size } else { (seq % 23) as usize }
}

/// The size that [`Message::make`] was given.
fn size_of(seq: u64, filler: usize) -> usize {
    if filler as u64 == seq % 23 { 0 } else { filler }
}

#[derive(Serialize, Deserialize, PartialEq)]
pub struct Text {
    data: String,
}

impl Message for Text {
    const TYPE: (&'static str, &'static str) = ("std_msgs", "String");

    fn make(seq: u64, stamp_ns: u64, size: usize) -> Self {
        let length = filler_length(seq, size);
        let mut filler: String = Noise(seq).take(length).iter().map(|b| format!("{b:02x}")).collect();
        filler.truncate(length);
        let body = format!("seq={seq} t={stamp_ns} fill={filler}");
        let crc = crc32fast::hash(body.as_bytes());
        Self { data: format!("{body} crc={crc:08x}") }
    }

    fn read(&self) -> Option<Reading> {
        let (seq, stamp_ns, filler) = parse(&self.data)?;
        Some(Reading { seq, stamp_ns, intact: *self == Self::make(seq, stamp_ns, size_of(seq, filler)) })
    }
}

/// A `wstring`: the count of UTF-16 code units, and the units. `ros2_client::WString` writes this and cannot read it
/// (it takes each unit for a `char` of four bytes), so it is spelt as the sequence that it is.
#[derive(Serialize, Deserialize, PartialEq)]
pub struct WideText {
    data: Vec<u16>,
}

/// One, two and three bytes of UTF-8 a character, and one that takes two units of UTF-16.
const WIDE: [char; 8] = ['a', '\u{e9}', '\u{416}', '\u{6f22}', '\u{3042}', '\u{1f916}', '\u{20ac}', 'z'];

impl Message for WideText {
    const TYPE: (&'static str, &'static str) = ("std_msgs", "WString");

    fn make(seq: u64, stamp_ns: u64, size: usize) -> Self {
        let noise = Noise(seq).take(filler_length(seq, size));
        let filler: String = noise.iter().map(|b| WIDE[usize::from(b & 7)]).collect();
        let mut text = format!("seq={seq} t={stamp_ns} fill={filler}");
        let bytes: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        text += &format!(" crc={:08x}", crc32fast::hash(&bytes));
        Self { data: text.encode_utf16().collect() }
    }

    fn read(&self) -> Option<Reading> {
        let (seq, stamp_ns, filler) = parse(&String::from_utf16(&self.data).ok()?)?;
        Some(Reading { seq, stamp_ns, intact: *self == Self::make(seq, stamp_ns, size_of(seq, filler)) })
    }
}

#[derive(Serialize, Deserialize, PartialEq)]
struct Header {
    sec: i32,
    nanosec: u32,
    frame_id: String,
}

impl Header {
    fn make(seq: u64, stamp_ns: u64) -> Self {
        Self {
            sec: (stamp_ns / 1_000_000_000) as i32,
            nanosec: (stamp_ns % 1_000_000_000) as u32,
            frame_id: format!("sgc/{seq}"),
        }
    }
}

/// Sequence number, time, checksum, and a cut of the repeated noise block.
fn bulk(seq: u64, stamp_ns: u64, size: usize) -> Vec<u8> {
    static BLOCK: std::sync::LazyLock<Vec<u8>> =
        std::sync::LazyLock::new(|| Noise(0x5347_435F_5045_4552).take(BLOCK_BYTES));
    let size = size.max(HEAD_BYTES);
    let mut data = Vec::with_capacity(size);
    data.extend_from_slice(&seq.to_le_bytes());
    data.extend_from_slice(&stamp_ns.to_le_bytes());
    data.extend_from_slice(&[0; 4]);
    let mut from = (seq.wrapping_mul(7919) % BLOCK_BYTES as u64) as usize;
    while data.len() < size {
        let run = (BLOCK_BYTES - from).min(size - data.len());
        data.extend_from_slice(&BLOCK[from..from + run]);
        from = 0;
    }
    let mut crc = crc32fast::Hasher::new();
    crc.update(&data[..16]);
    crc.update(&data[HEAD_BYTES..]);
    data[16..HEAD_BYTES].copy_from_slice(&crc.finalize().to_le_bytes());
    data
}

/// Sequence number and time of [`bulk`].
fn read_bulk(data: &[u8]) -> Option<(u64, u64)> {
    let word = |at: usize| Some(u64::from_le_bytes(data.get(at..at + 8)?.try_into().ok()?));
    Some((word(0)?, word(8)?)).filter(|_| data.len() >= HEAD_BYTES)
}

#[derive(Serialize, Deserialize, PartialEq)]
pub struct Image {
    header: Header,
    height: u32,
    width: u32,
    encoding: String,
    is_bigendian: u8,
    step: u32,
    #[serde(with = "serde_bytes")]
    data: Vec<u8>,
}

impl Message for Image {
    const TYPE: (&'static str, &'static str) = ("sensor_msgs", "Image");

    fn make(seq: u64, stamp_ns: u64, size: usize) -> Self {
        let data = bulk(seq, stamp_ns, size);
        let size = data.len() as u32;
        Self {
            header: Header::make(seq, stamp_ns),
            height: 1,
            width: size,
            encoding: "mono8".into(),
            is_bigendian: 0,
            step: size,
            data,
        }
    }

    fn read(&self) -> Option<Reading> {
        let (seq, stamp_ns) = read_bulk(&self.data)?;
        Some(Reading { seq, stamp_ns, intact: *self == Self::make(seq, stamp_ns, self.data.len()) })
    }
}

#[derive(Serialize, Deserialize, PartialEq)]
struct PointField {
    name: String,
    offset: u32,
    datatype: u8,
    count: u32,
}

#[derive(Serialize, Deserialize, PartialEq)]
pub struct PointCloud {
    header: Header,
    height: u32,
    width: u32,
    fields: Vec<PointField>,
    is_bigendian: bool,
    point_step: u32,
    row_step: u32,
    #[serde(with = "serde_bytes")]
    data: Vec<u8>,
    is_dense: bool,
}

const POINT_BYTES: usize = 16;
const FLOAT32: u8 = 7;

impl Message for PointCloud {
    const TYPE: (&'static str, &'static str) = ("sensor_msgs", "PointCloud2");

    fn make(seq: u64, stamp_ns: u64, size: usize) -> Self {
        let size = if size == 0 { 6_000_000 } else { size };
        let points = size.div_ceil(POINT_BYTES).max(2);
        let names = ["x", "y", "z", "intensity"];
        let field = |(i, name): (u32, &str)| PointField {
            name: name.into(),
            offset: 4 * i,
            datatype: FLOAT32,
            count: 1,
        };
        Self {
            header: Header::make(seq, stamp_ns),
            height: 1,
            width: points as u32,
            fields: (0..).zip(names).map(field).collect(),
            is_bigendian: false,
            point_step: POINT_BYTES as u32,
            row_step: (points * POINT_BYTES) as u32,
            data: bulk(seq, stamp_ns, points * POINT_BYTES),
            is_dense: true,
        }
    }

    fn read(&self) -> Option<Reading> {
        let (seq, stamp_ns) = read_bulk(&self.data)?;
        Some(Reading { seq, stamp_ns, intact: *self == Self::make(seq, stamp_ns, self.data.len()) })
    }
}

#[derive(Serialize, Deserialize, PartialEq)]
struct Inner {
    offset: i16,
    weight: f64,
    label: String,
}

/// A type that no ROS distribution has: nested, bounded, mixed alignment, and a tail of odd length.
#[derive(Serialize, Deserialize, PartialEq)]
pub struct Odd {
    flag: bool,
    seq: u64,
    stamp_ns: u64,
    crc: u32,
    inner: Inner,
    parts: Vec<Inner>,
    codes: Vec<u16>,
    fixed: [f32; 3],
    #[serde(with = "serde_bytes")]
    tail: Vec<u8>,
}

impl Message for Odd {
    const TYPE: (&'static str, &'static str) = ("sgc_test_msgs", "Odd");

    fn make(seq: u64, stamp_ns: u64, _: usize) -> Self {
        let mut noise = Noise(seq);
        let mut inners: Vec<Inner> = (0..=seq % 5)
            .map(|i| Inner {
                offset: (noise.next() % 2000) as i16 - 1000,
                weight: (noise.next() % 100_000) as f64 / 8.0,
                label: format!("part-{i}-{}", seq % 1000),
            })
            .collect();
        let inner = inners.remove(0);
        let codes: Vec<u16> = (0..seq % 33).map(|_| (noise.next() % 65536) as u16).collect();
        let fixed = [(); 3].map(|()| (noise.next() % 4096) as f32 / 4.0);
        let tail = noise.take(1 + 2 * (seq % 31) as usize);
        let mut crc = crc32fast::Hasher::new();
        crc.update(&seq.to_le_bytes());
        crc.update(&stamp_ns.to_le_bytes());
        codes.iter().for_each(|code| crc.update(&code.to_le_bytes()));
        crc.update(&tail);
        let crc = crc.finalize();
        Self { flag: seq % 2 == 1, seq, stamp_ns, crc, inner, parts: inners, codes, fixed, tail }
    }

    fn read(&self) -> Option<Reading> {
        let intact = *self == Self::make(self.seq, self.stamp_ns, 0);
        Some(Reading { seq: self.seq, stamp_ns: self.stamp_ns, intact })
    }
}
