//! Names that somebody may have meant.

/// Names that are shown at most.
const SHOWN_MAX: usize = 3;
/// Longest names that are compared letter by letter, bytes.
const COMPARED_BYTES_MAX: usize = 256;

/// Those of `candidates` that are nearly `name`: in another namespace, in other letters, or a few letters away.
pub(super) fn near<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Vec<&'a str> {
    let mut found: Vec<(usize, &str)> = candidates
        .into_iter()
        .filter(|candidate| *candidate != name)
        .filter_map(|candidate| Some((distance(name, candidate)?, candidate)))
        .collect();
    found.sort_unstable();
    found.dedup();
    found.into_iter().take(SHOWN_MAX).map(|(_, candidate)| candidate).collect()
}

/// `"; did you mean /a or /b?"`, or nothing.
pub(super) fn hint(near: &[&str]) -> String {
    match near {
        [] => String::new(),
        all => format!("; did you mean {}?", all.join(" or ")),
    }
}

/// How far apart two names are; `None` if they are others.
fn distance(a: &str, b: &str) -> Option<usize> {
    if a.len() > COMPARED_BYTES_MAX || b.len() > COMPARED_BYTES_MAX {
        return None;
    }
    if a.eq_ignore_ascii_case(b) {
        return Some(0);
    }
    let (long, short) = if a.len() > b.len() { (a, b) } else { (b, a) };
    if short.len() > 1 && long.ends_with(short) && short.starts_with('/') {
        return Some(1);
    }
    let edits = edits(a.as_bytes(), b.as_bytes());
    (edits <= (a.len() / 5).clamp(1, 3)).then_some(edits + 1)
}

/// Letters to be put in, taken out or replaced (Levenshtein).
fn edits(a: &[u8], b: &[u8]) -> usize {
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let replaced = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_were_meant_are_found() {
        let all = ["/chatter", "/robot/chatter", "/Chater", "/chat", "/scan", "/CHATTER"];
        assert_eq!(near("/chatter", all), ["/CHATTER", "/robot/chatter"]);
        assert_eq!(near("/chater", all), ["/Chater", "/chatter"]);
        assert_eq!(near("/scans", all), ["/scan"]);
        assert!(near("/odom", all).is_empty());
        assert_eq!(hint(&["/a", "/b"]), "; did you mean /a or /b?");
    }
}
