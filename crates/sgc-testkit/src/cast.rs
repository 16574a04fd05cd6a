//! The fleets and identities of all tests, made once per process and the same in every process.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_sync::lock;
use sgc_trust::{EnrollRequest, Fleet, Identity, Revocation, TrustAnchors};
use sgc_wire::UnixMillis;

use crate::clock::GENESIS;

/// Time at which the fleets were made, early enough before the world that clocks may be wrong by days.
const BIRTH: UnixMillis = UnixMillis(GENESIS.0 - 30 * 86_400_000);

/// A member of a fleet.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Member {
    /// The member's name.
    pub name: String,
    /// The member's fleet.
    pub fleet: String,
    /// The member's groups.
    pub groups: Vec<String>,
    /// The identity is a router's, without the fleet secret.
    pub router: bool,
    /// The member may forward for others.
    pub may_route: bool,
    /// Time of its certificate after the beginning of the world; `None` stands for a month before.
    pub from: Option<Duration>,
    /// Validity of its certificate; `None` stands for longer than any test.
    pub valid: Option<Duration>,
    /// Number of the node's certificate, from 0.
    pub renewal: u32,
    /// Number of enrolments after a revocation.
    pub incarnation: u32,
}

impl Member {
    /// Returns a member of the default fleet of tests, in no group.
    pub fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            fleet: "acme".to_owned(),
            groups: Vec::new(),
            router: false,
            may_route: false,
            from: None,
            valid: None,
            renewal: 0,
            incarnation: 0,
        }
    }
}

#[derive(Default)]
struct Cast {
    fleets: BTreeMap<String, Fleet>,
    identities: BTreeMap<Member, Arc<Identity>>,
}

impl Cast {
    fn fleet(&mut self, name: &str) -> &mut Fleet {
        self.fleets.entry(name.to_owned()).or_insert_with(|| {
            let legal = name.parse().expect("tests name fleets legally");
            Fleet::create(legal, BIRTH, &mut rng(name)).expect("the provider makes a CA")
        })
    }
}

fn cast() -> MutexGuard<'static, Cast> {
    static CAST: OnceLock<Mutex<Cast>> = OnceLock::new();
    lock(CAST.get_or_init(Mutex::default))
}

/// Returns the identity of a member, which is the same on every call.
pub fn identity(member: &Member) -> Arc<Identity> {
    let mut cast = cast();
    if let Some(identity) = cast.identities.get(member) {
        return identity.clone();
    }
    let usual = EnrollRequest::new(
        member.name.parse().expect("tests name nodes legally"),
        match (member.from, member.valid) {
            (None, None) => BIRTH,
            (from, _) => UnixMillis(GENESIS.0 + from.unwrap_or_default().as_millis() as u64),
        },
    );
    let request = EnrollRequest {
        groups: member.groups.iter().map(|g| g.parse().expect("tests name groups legally")).collect(),
        router: member.router,
        may_route: member.may_route,
        valid: member.valid.unwrap_or(usual.valid),
        ..usual
    };
    let seed = match (member.renewal, member.incarnation) {
        (0, 0) => format!("{}/{}", member.fleet, member.name),
        (n, 0) => format!("{}/{}/{n}", member.fleet, member.name),
        (n, again) => format!("{}/{}/{n}/{again}", member.fleet, member.name),
    };
    let fleet = cast.fleet(&member.fleet);
    let made = match member.incarnation {
        0 => fleet.issue(&request, &mut rng(&seed)),
        again => {
            // In a copy of the fleet file, so that other members do not depend on the order of calls.
            let mut copy = Fleet::parse(&fleet.to_text()).expect("it was written by itself");
            let request = EnrollRequest { again: true, ..request };
            copy.enroll(&request, &mut rng(&seed)).expect("a fresh CA enrols");
            (0..again)
                .fold(None, |_, _| {
                    copy.revoke(std::slice::from_ref(&request.node), request.now).expect("it is enrolled");
                    Some(copy.enroll(&request, &mut rng(&seed)))
                })
                .expect("at least once")
        }
    };
    let identity = Arc::new(made.expect("a fresh CA enrols"));
    cast.identities.insert(member.clone(), identity.clone());
    identity
}

/// Returns the holder with this number of an invitation to a fleet, whose authority is the node `keeper`.
pub fn invited(fleet: &str, number: u32) -> Arc<Identity> {
    let mut cast = cast();
    let mut copy = Fleet::parse(&cast.fleet(fleet).to_text()).expect("it was written by itself");
    let rng = &mut rng(&format!("{fleet}/invited/{number}"));
    copy.set_authority(Some("keeper".parse().expect("a legal name")), BIRTH).expect("a fresh fleet");
    let request = EnrollRequest::new("invited".parse().expect("a legal name"), GENESIS);
    let made = copy
        .invite(&request, Duration::from_secs(86_400), vec!["quic://hub:7447".into()], rng)
        .expect("a fresh CA invites");
    Arc::new(made.identity(rng).expect("it fits together"))
}

/// Returns these trust anchors with the CA of a fleet added.
pub(crate) fn with_fleet(anchors: &TrustAnchors, fleet: &str) -> TrustAnchors {
    let ca = cast().fleet(fleet).ca_certificate().clone();
    anchors.with_anchors([ca]).expect("a CA that was made well")
}

/// Returns a list of a fleet that revokes only these members in their incarnations, like a list of a copy of the fleet
/// file that does not know the revocations of another copy.
pub fn revocation_list(fleet: &str, members: &[Member], number: u64) -> Bytes {
    let mut cast = cast();
    let fleet = cast.fleet(fleet);
    let revoked = |m: &Member| {
        let revocation = Revocation { incarnation: m.incarnation, at: GENESIS };
        (fleet.secret().pseudonym(&m.name), revocation)
    };
    let revoked: Vec<_> = members.iter().map(revoked).collect();
    fleet.revocation_list_of_nodes(&revoked, number, GENESIS).expect("a fresh CA signs").into()
}

/// Returns a list of serial numbers, as a CA writes it that does not know SGC.
pub fn serial_list(fleet: &str, members: &[Member], number: u64) -> Bytes {
    let revoked: Vec<_> =
        members.iter().map(|m| (identity(m).as_peer().cert.serial.clone(), GENESIS)).collect();
    let mut cast = cast();
    let fleet = cast.fleet(fleet);
    fleet.revocation_list_of(&revoked, number, GENESIS).expect("a fresh CA signs").into()
}

/// Returns a generator seeded by a text.
fn rng(text: &str) -> ChaCha20Rng {
    // FNV-1a: the seed only has to differ for different texts.
    let seed = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    ChaCha20Rng::seed_from_u64(seed)
}
