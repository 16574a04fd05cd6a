//! The USER_DATA of endpoints: `key=value;` elements, as rmw writes them.
//!
//! The module is pure. Three keys matter here: `typehash` (REP 2016, written by rmw since Iron) of endpoints,
//! `enclave` of participants, and `sgc` of both, by which SGC nodes recognise each other's endpoints and avoid loops.

const TAG_KEY: &str = "sgc";
const TYPE_HASH_KEY: &str = "typehash";
const ENCLAVE_KEY: &str = "enclave";

/// The enclave of a participant without security. Every rmw needs it, because a participant without an enclave does
/// not count as ROS 2.
pub const DEFAULT_ENCLAVE: &str = "/";

/// Longest value, in bytes.
pub const VALUE_BYTES_MAX: usize = 128;

/// Most bytes of USER_DATA that are examined. The rest is ignored.
pub const USER_DATA_BYTES_MAX: usize = 4096;

/// Returns `true` if a text is a valid value: printable ASCII without the separators, not empty and within the bound.
pub fn is_value(text: &str) -> bool {
    (1..=VALUE_BYTES_MAX).contains(&text.len())
        && text.bytes().all(|b| (b.is_ascii_graphic() || b == b' ') && b != b';' && b != b'=')
}

/// Returns the USER_DATA of an endpoint created here. The caller has checked both values with [`is_value`].
pub fn build(tag: Option<&str>, type_hash: Option<&str>) -> Vec<u8> {
    joined([(TAG_KEY, tag), (TYPE_HASH_KEY, type_hash)])
}

/// Returns the USER_DATA of a participant created here. The caller has checked both values with [`is_value`].
pub fn for_participant(tag: Option<&str>, enclave: Option<&str>) -> Vec<u8> {
    joined([(ENCLAVE_KEY, enclave), (TAG_KEY, tag)])
}

/// Returns the USER_DATA of a participant while it is opened. It differs from the later one, so that Cyclone
/// announces the change.
pub fn while_opening(later: &[u8]) -> Vec<u8> {
    [later, b"opening=1;"].concat()
}

fn joined(elements: [(&str, Option<&str>); 2]) -> Vec<u8> {
    let mut text = String::new();
    for (key, value) in elements {
        if let Some(value) = value {
            text.push_str(key);
            text.push('=');
            text.push_str(value);
            text.push(';');
        }
    }
    text.into_bytes()
}

/// Returns `true` if any SGC node created the endpoint.
pub fn is_tagged(user_data: &[u8]) -> bool {
    elements(user_data).any(|(key, _)| key == TAG_KEY.as_bytes())
}

/// Returns the name of the SGC node that created the endpoint or participant.
pub fn tag(user_data: &[u8]) -> Option<&str> {
    value_of(user_data, TAG_KEY).filter(|value| is_value(value))
}

/// Returns the type hash (`RIHS01_…`) of an endpoint, if it carries a plausible one.
pub fn type_hash(user_data: &[u8]) -> Option<String> {
    value_of(user_data, TYPE_HASH_KEY)
        .filter(|value| value.starts_with("RIHS") && is_value(value))
        .map(str::to_owned)
}

/// Returns the enclave of a participant. Only ROS 2 participants have one.
pub fn enclave(user_data: &[u8]) -> Option<&str> {
    value_of(user_data, ENCLAVE_KEY)
}

/// Returns the value of the first element with this key, if it is UTF-8.
fn value_of<'a>(user_data: &'a [u8], key: &str) -> Option<&'a str> {
    let (_, value) = elements(user_data).find(|(other, _)| *other == key.as_bytes())?;
    std::str::from_utf8(value).ok()
}

fn elements(user_data: &[u8]) -> impl Iterator<Item = (&[u8], &[u8])> {
    let bounded = &user_data[..user_data.len().min(USER_DATA_BYTES_MAX)];
    bounded.split(|b| *b == b';').filter_map(|element| {
        let at = element.iter().position(|b| *b == b'=')?;
        Some((&element[..at], &element[at + 1..]))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn user_data_is_parsed_as_built() {
        let data = build(Some("arm-1"), Some("RIHS01_ab"));
        assert_eq!(data, b"sgc=arm-1;typehash=RIHS01_ab;");
        assert!(is_tagged(&data));
        assert_eq!(type_hash(&data).as_deref(), Some("RIHS01_ab"));
        assert!(build(None, None).is_empty());
        let participant = for_participant(Some("arm-1"), Some(DEFAULT_ENCLAVE));
        assert_eq!(participant, b"enclave=/;sgc=arm-1;");
        assert!(is_tagged(&participant));
        assert_eq!((enclave(&participant), enclave(&data)), (Some("/"), None));
        assert_eq!(enclave(b"enclave=\xff;"), None);
    }

    #[test]
    fn the_tag_is_known_whatever_node_and_order() {
        assert!(is_tagged(b"typehash=RIHS01_ab;sgc=another node;"));
        assert!(is_tagged(b"sgc=x"));
        assert!(!is_tagged(b"typehash=sgc;notsgc=1;sgcx=1;sgc;"));
        assert!(!is_tagged(b""));
    }

    #[test]
    fn foreign_data_never_makes_a_hash() {
        assert_eq!(type_hash(b"typehash=RIHS01_ab"), Some("RIHS01_ab".into()));
        assert_eq!(type_hash(b"typehash=;"), None);
        assert_eq!(type_hash(b"typehash=MD5_00;"), None);
        assert_eq!(type_hash(b"typehash=RIHS01_\xff;"), None);
        assert_eq!(type_hash(&[b'='; 10_000]), None);
        let long = [b"typehash=RIHS01_".as_slice(), &[b'a'; 200], b";"].concat();
        assert_eq!(type_hash(&long), None);
    }
}
