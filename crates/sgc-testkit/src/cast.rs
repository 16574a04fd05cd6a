//! Who plays: fleets and identities, made once per process and the same in every process.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_trust::{EnrollRequest, Fleet, Identity};

use crate::clock::GENESIS;

/// A member of a fleet.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Member {
    /// Its name.
    pub name: String,
    /// Its fleet.
    pub fleet: String,
    /// Its groups.
    pub groups: Vec<String>,
    /// True for an identity without the fleet secret.
    pub router: bool,
}

impl Member {
    /// A member of the fleet that tests use unless they need two, in no group.
    pub fn new(name: &str) -> Self {
        Self { name: name.to_owned(), fleet: "acme".to_owned(), groups: Vec::new(), router: false }
    }
}

#[derive(Default)]
struct Cast {
    fleets: BTreeMap<String, Fleet>,
    identities: BTreeMap<Member, Arc<Identity>>,
}

/// The identity of a member; the same one whenever it is asked for.
pub fn identity(member: &Member) -> Arc<Identity> {
    static CAST: OnceLock<Mutex<Cast>> = OnceLock::new();
    let mut cast = CAST.get_or_init(Mutex::default).lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(identity) = cast.identities.get(member) {
        return identity.clone();
    }
    let fleet = cast.fleets.entry(member.fleet.clone()).or_insert_with(|| {
        let name = member.fleet.parse().expect("tests name fleets legally");
        Fleet::create(name, GENESIS, &mut rng(&member.fleet)).expect("the provider makes a CA")
    });
    let request = EnrollRequest {
        groups: member.groups.iter().map(|g| g.parse().expect("tests name groups legally")).collect(),
        router: member.router,
        ..EnrollRequest::new(member.name.parse().expect("tests name nodes legally"), GENESIS)
    };
    let seed = format!("{}/{}", member.fleet, member.name);
    let identity = Arc::new(fleet.issue(&request, &mut rng(&seed)).expect("a fresh CA enrols"));
    cast.identities.insert(member.clone(), identity.clone());
    identity
}

/// A generator that depends on a text alone.
fn rng(text: &str) -> ChaCha20Rng {
    // FNV-1a: only has to differ for different texts.
    let seed = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    ChaCha20Rng::seed_from_u64(seed)
}
