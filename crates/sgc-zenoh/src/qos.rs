//! The QoS in a liveliness token: numbers of rmw's policies, empty where they are rmw_zenoh's defaults.
//!
//! Sources: rmw_zenoh `liveliness_utils.cpp`@3411fdec, `qos_to_keyexpr` and `keyexpr_to_qos`, and `qos.cpp`@7efeee2b for
//! the defaults.

use std::fmt::Display;

use sgc_wire::{Durability, History, Liveliness, Qos, Reliability};

use crate::error::{CodecError, Field};
use crate::text::number;

/// The depth of rmw_zenoh's default QoS, which a token leaves out.
pub const DEPTH_DEFAULT: u32 = 42;
/// Deepest history that is read. A deeper one becomes this, which is one less than [`History::UNSAID`]: a token says the
/// depth always.
pub const DEPTH_MAX: u32 = i32::MAX as u32 - 1;

/// Separates policies.
const POLICIES: char = ':';
/// Separates the numbers of one policy.
const NUMBERS: char = ',';

/// An infinite duration (rmw `RMW_DURATION_INFINITE`), the default of all three: 2⁶³ − 1 nanoseconds, as seconds and
/// nanoseconds. Each of the two is left out by itself.
const INFINITE_NS: u64 = i64::MAX as u64;
const INFINITE: (u64, u64) = (INFINITE_NS / NS_PER_S, INFINITE_NS % NS_PER_S);
const NS_PER_S: u64 = 1_000_000_000;

/// Writes the QoS of an endpoint as rmw_zenoh does.
///
/// Policies that rmw does not have become weaker ones: [`Liveliness::ManualByParticipant`] becomes automatic,
/// [`Durability::Transient`] and [`Durability::Persistent`] become transient local. Partitions and data
/// representations are left out. A depth of 0 is 1, as on SGC's wire, and 2⁶³ − 1 ns or more are infinite.
///
/// # Errors
/// [`CodecError::NoDepth`] for [`History::UNSAID`].
pub fn encode_qos(qos: &Qos) -> Result<String, CodecError> {
    let reliability = match qos.reliability {
        Reliability::Reliable => "",
        Reliability::BestEffort => "2",
    };
    let durability = match qos.durability {
        Durability::Volatile => "",
        Durability::TransientLocal | Durability::Transient | Durability::Persistent => "1",
    };
    let (history, depth) = match qos.history {
        unsaid if unsaid.is_unsaid() => return Err(CodecError::NoDepth),
        History::KeepLast(depth) => ("", unless_default(depth.max(1), DEPTH_DEFAULT)),
        History::KeepAll => ("2", String::new()),
    };
    let liveliness = match qos.liveliness {
        Liveliness::Automatic | Liveliness::ManualByParticipant => "",
        Liveliness::ManualByTopic => "3",
    };
    let (deadline, lifespan) = (duration(qos.deadline_ns), duration(qos.lifespan_ns));
    let lease = duration(qos.lease_ns);
    Ok(format!("{reliability}:{durability}:{history},{depth}:{deadline}:{lifespan}:{liveliness},{lease}"))
}

/// Reads the QoS of an endpoint.
///
/// rmw_zenoh's parser takes the same numbers and refuses the same; missing policies, which it refuses, are defaults here
/// like empty ones. Numbers that are no policy of DDS (system default, unknown, best available) are the defaults, too.
/// A duration of 0 is infinite, because rmw does not set it, and a depth of 0 is [`DEPTH_DEFAULT`].
///
/// # Errors
/// [`CodecError::Unknown`] for a policy, [`CodecError::Number`].
pub fn decode_qos(text: &str) -> Result<Qos, CodecError> {
    let mut policies = text.split(POLICIES);
    let mut policy = || policies.next().unwrap_or_default().split(NUMBERS);
    let unknown = |field| CodecError::Unknown { field };

    let reliability = match policy().next().unwrap_or_default() {
        "" | "0" | "1" | "3" => Reliability::Reliable,
        "2" => Reliability::BestEffort,
        _ => return Err(unknown(Field::Reliability)),
    };
    let durability = match policy().next().unwrap_or_default() {
        "" | "0" | "2" | "3" => Durability::Volatile,
        "1" => Durability::TransientLocal,
        _ => return Err(unknown(Field::Durability)),
    };
    let mut history = policy();
    let kind = history.next().unwrap_or_default();
    let depth = match or_default(Field::Depth, history.next(), DEPTH_DEFAULT.into())? {
        0 => DEPTH_DEFAULT,
        depth => u32::try_from(depth).unwrap_or(DEPTH_MAX).min(DEPTH_MAX),
    };
    let history = match kind {
        "" | "0" | "1" | "3" => History::KeepLast(depth),
        "2" => History::KeepAll,
        _ => return Err(unknown(Field::History)),
    };
    let deadline_ns = nanoseconds(Field::Deadline, policy())?;
    let lifespan_ns = nanoseconds(Field::Lifespan, policy())?;
    let mut lease = policy();
    let liveliness = match lease.next().unwrap_or_default() {
        "" | "0" | "1" | "4" | "5" => Liveliness::Automatic,
        "3" => Liveliness::ManualByTopic,
        _ => return Err(unknown(Field::Liveliness)),
    };
    let lease_ns = nanoseconds(Field::Lease, lease)?;
    Ok(Qos {
        reliability,
        durability,
        history,
        deadline_ns,
        lifespan_ns,
        liveliness,
        lease_ns,
        ..Qos::default()
    })
}

/// Returns seconds and nanoseconds of a duration, each left out if it is that of an infinite one.
fn duration(ns: Option<u64>) -> String {
    let ns = ns.unwrap_or(INFINITE_NS).min(INFINITE_NS);
    let (s, ns) = (unless_default(ns / NS_PER_S, INFINITE.0), unless_default(ns % NS_PER_S, INFINITE.1));
    format!("{s},{ns}")
}

/// Reads seconds and nanoseconds of a duration.
fn nanoseconds<'a>(
    field: Field,
    mut numbers: impl Iterator<Item = &'a str>,
) -> Result<Option<u64>, CodecError> {
    let s = or_default(field, numbers.next(), INFINITE.0)?;
    let ns = or_default(field, numbers.next(), INFINITE.1)?;
    let finite = s.checked_mul(NS_PER_S).and_then(|whole| whole.checked_add(ns));
    Ok(finite.filter(|ns| (1..INFINITE_NS).contains(ns)))
}

fn unless_default<N: Display + PartialEq>(number: N, default: N) -> String {
    if number == default { String::new() } else { number.to_string() }
}

fn or_default(field: Field, text: Option<&str>, default: u64) -> Result<u64, CodecError> {
    match text.unwrap_or_default() {
        "" => Ok(default),
        digits => number(field, digits),
    }
}

#[cfg(test)]
mod tests {
    use sgc_testkit::Dice;
    use sgc_wire::Representations;

    use super::*;

    fn keep_last(depth: u32) -> Qos {
        Qos { history: History::KeepLast(depth), ..Qos::default() }
    }

    /// The first four from tokens of running nodes.
    #[test]
    fn defaults_are_left_out() {
        let rosout = Qos {
            durability: Durability::TransientLocal,
            lifespan_ns: Some(10 * NS_PER_S),
            ..keep_last(1000)
        };
        let all = Qos {
            reliability: Reliability::BestEffort,
            durability: Durability::TransientLocal,
            history: History::KeepAll,
            deadline_ns: Some(1),
            lifespan_ns: Some(2 * NS_PER_S + 3),
            liveliness: Liveliness::ManualByTopic,
            lease_ns: Some(INFINITE_NS - 1),
            ..Qos::default()
        };
        for (qos, text) in [
            (keep_last(10), "::,10:,:,:,,"),
            (keep_last(7), "::,7:,:,:,,"),
            (rosout, ":1:,1000:,:10,0:,,"),
            (keep_last(1000), "::,1000:,:,:,,"),
            (keep_last(DEPTH_DEFAULT), "::,:,:,:,,"),
            (all, "2:1:2,:0,1:2,3:3,,854775806"),
        ] {
            assert_eq!(encode_qos(&qos).as_deref(), Ok(text));
            assert_eq!(decode_qos(text), Ok(qos), "{text}");
        }
    }

    #[test]
    fn other_spellings_are_read() {
        let infinite = "9223372036,854775807";
        for (text, qos) in [
            (format!("1:1:1,42:{infinite}:{infinite}:1,{infinite}"), ":1:,:,:,:,,"),
            ("1:2:1,42:,:,:1,,".to_owned(), "::,:,:,:,,"),
            ("0:0:0,0:0,0:0,0:0,0,0".to_owned(), "::,:,:,:,,"),
            ("3:3:3,:,:,:4,,".to_owned(), "::,:,:,:,,"),
            ("::,:,:,:5,,".to_owned(), "::,:,:,:,,"),
            ("::2,10:,:,:,,".to_owned(), "::2,:,:,:,,"),
            ("::2,0:,:,:,,".to_owned(), "::2,:,:,:,,"),
            ("2::,:,:,:,,:later:versions".to_owned(), "2::,:,:,:,,"),
            ("".to_owned(), "::,:,:,:,,"),
            ("::".to_owned(), "::,:,:,:,,"),
            ("::,007".to_owned(), "::,7:,:,:,,"),
            ("::,:18446744073709551615,0:,18446744073709551615:,,".to_owned(), "::,:,:,:,,"),
            ("::,:1,5000000000:,:,,".to_owned(), "::,:6,0:,:,,"),
        ] {
            let read = decode_qos(&text).unwrap();
            assert_eq!(encode_qos(&read).as_deref(), Ok(qos), "{text:?}");
        }
        for depth in ["2147483646", "2147483647", "4294967296", "18446744073709551615"] {
            let read = decode_qos(&format!("::,{depth}:,:,:,,")).unwrap();
            assert_eq!(read.history, History::KeepLast(DEPTH_MAX));
            assert!(!read.history.is_unsaid());
        }
    }

    #[test]
    fn values_that_rmw_zenoh_refuses_are_refused() {
        for (text, field) in [
            ("4::,:,:,:,,", Field::Reliability),
            (":4:,:,:,:,,", Field::Durability),
            ("::4,:,:,:,,", Field::History),
            ("::,:,:,:2,,", Field::Liveliness),
            ("::,:,:,:6,,", Field::Liveliness),
            ("01::,:,:,:,,", Field::Reliability),
            (" ::,:,:,:,,", Field::Reliability),
        ] {
            assert_eq!(decode_qos(text), Err(CodecError::Unknown { field }), "{text}");
        }
        for (text, field) in [
            ("::,x:,:,:,,", Field::Depth),
            ("::,-1:,:,:,,", Field::Depth),
            ("::,18446744073709551616:,:,:,,", Field::Depth),
            ("::,:1.5,:,:,,", Field::Deadline),
            ("::,:,:,x:,,", Field::Lifespan),
            ("::,:,:,:,,x", Field::Lease),
        ] {
            assert_eq!(decode_qos(text), Err(CodecError::Number { field }), "{text}");
        }
    }

    #[test]
    fn policies_that_rmw_does_not_have_become_weaker_ones() {
        let qos = |qos: Qos| encode_qos(&Qos { history: History::KeepLast(DEPTH_DEFAULT), ..qos });
        let plain = Ok("::,:,:,:,,".to_owned());
        assert_eq!(qos(Qos { liveliness: Liveliness::ManualByParticipant, ..Qos::default() }), plain);
        assert_eq!(qos(Qos { partitions: vec!["a".into()], ..Qos::default() }), plain);
        assert_eq!(qos(Qos { representations: Representations::XCDR2, ..Qos::default() }), plain);
        assert_eq!(
            qos(Qos { deadline_ns: Some(u64::MAX), lease_ns: Some(INFINITE_NS), ..Qos::default() }),
            plain
        );
        for durability in [Durability::Transient, Durability::Persistent] {
            assert_eq!(qos(Qos { durability, ..Qos::default() }), Ok(":1:,:,:,:,,".to_owned()));
        }
        assert_eq!(encode_qos(&keep_last(0)), encode_qos(&keep_last(1)));
        assert_eq!(encode_qos(&Qos { history: History::UNSAID, ..Qos::default() }), Err(CodecError::NoDepth));
    }

    #[test]
    fn random_qos_round_trip() {
        let mut dice = Dice::new(1);
        for _ in 0..5000 {
            let mut duration = || match dice.below(4) {
                0 => None,
                1 => Some(1 + dice.number() % (INFINITE_NS - 1)),
                2 => Some(INFINITE.0 * NS_PER_S + dice.number() % INFINITE.1),
                _ => Some(dice.number() % 1000 * NS_PER_S + INFINITE.1),
            };
            let (deadline_ns, lifespan_ns, lease_ns) = (duration(), duration(), duration());
            let history = match dice.below(3) {
                0 => History::KeepAll,
                1 => History::KeepLast(dice.within(1..=100) as u32),
                _ => History::KeepLast(dice.within(1..=DEPTH_MAX as usize) as u32),
            };
            let qos = Qos {
                reliability: dice.pick(&[Reliability::Reliable, Reliability::BestEffort]).unwrap(),
                durability: dice.pick(&[Durability::Volatile, Durability::TransientLocal]).unwrap(),
                history,
                deadline_ns,
                lifespan_ns,
                liveliness: dice.pick(&[Liveliness::Automatic, Liveliness::ManualByTopic]).unwrap(),
                lease_ns,
                ..Qos::default()
            };
            let text = encode_qos(&qos).unwrap();
            assert_eq!(decode_qos(&text), Ok(qos), "{text}");
        }
    }

    #[test]
    fn random_text_is_read_or_refused() {
        let mut dice = Dice::new(2);
        let mut read = 0;
        for _ in 0..50_000 {
            let text: String = (0..dice.within(0..=30))
                .filter_map(|_| dice.pick(&['1', '2', '9', ':', ':', ',', ',']))
                .collect();
            if let Ok(qos) = decode_qos(&text) {
                read += 1;
                assert_eq!(decode_qos(&encode_qos(&qos).unwrap()), Ok(qos), "{text}");
            }
        }
        assert!(read > 100, "{read} texts were read");
    }
}
