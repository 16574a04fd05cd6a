//! Paths of members in errors: `pose.position.x`, `transforms[2].header`. They are assembled on the way up, so that
//! valid input costs nothing.

/// Puts a member in front.
pub(crate) fn under(path: &mut String, member: &str) {
    let separator = if path.is_empty() || path.starts_with('[') { "" } else { "." };
    path.insert_str(0, &format!("{member}{separator}"));
}

/// Puts the place in a sequence in front.
pub(crate) fn at(path: &mut String, index: usize) {
    let separator = if path.is_empty() { "" } else { "." };
    path.insert_str(0, &format!("[{index}]{separator}"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_put_together_from_behind() {
        let mut path = String::new();
        under(&mut path, "x");
        under(&mut path, "position");
        at(&mut path, 2);
        under(&mut path, "poses");
        assert_eq!(path, "poses[2].position.x");
        let mut leaf = String::new();
        at(&mut leaf, 3);
        under(&mut leaf, "data");
        assert_eq!(leaf, "data[3]");
    }
}
