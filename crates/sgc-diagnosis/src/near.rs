//! Finds names that a user may have meant by a misspelt one.

/// Most names shown.
const SHOWN_MAX: usize = 3;
/// Longest name that is compared letter by letter, in bytes.
const COMPARED_BYTES_MAX: usize = 256;

/// Returns the `candidates` close to `name`: in another namespace, in other case, or a few letters away.
pub(crate) fn near<'a>(name: &str, candidates: impl IntoIterator<Item = &'a str>) -> Vec<&'a str> {
    let mut found: Vec<(usize, &str)> = candidates
        .into_iter()
        .filter(|candidate| *candidate != name)
        .filter_map(|candidate| Some((distance(name, candidate)?, candidate)))
        .collect();
    found.sort_unstable();
    found.dedup();
    found.into_iter().take(SHOWN_MAX).map(|(_, candidate)| candidate).collect()
}

/// Formats `"; did you mean /a or /b?"`, or nothing.
pub(crate) fn hint(near: &[String]) -> String {
    match near {
        [] => String::new(),
        all => format!("; did you mean {}?", all.join(" or ")),
    }
}

/// Returns the distance of two names, or `None` if they are too different.
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

/// Returns the number of insertions, deletions and replacements (Levenshtein).
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
    fn similar_names_are_found() {
        let all = ["/chatter", "/robot/chatter", "/Chater", "/chat", "/scan", "/CHATTER"];
        assert_eq!(near("/chatter", all), ["/CHATTER", "/robot/chatter"]);
        assert_eq!(near("/chater", all), ["/Chater", "/chatter"]);
        assert_eq!(near("/scans", all), ["/scan"]);
        assert!(near("/odom", all).is_empty());
        assert_eq!(hint(&["/a".to_owned(), "/b".to_owned()]), "; did you mean /a or /b?");
    }
}
