//! Common helpers of the tests of several modules.

use crate::layout::Layout;
use crate::library::Library;

/// Returns the layout of a message of this definition, which may contain `Two` and `Empty`.
pub(crate) fn layout(text: &str) -> Layout {
    let mut texts = |file: &crate::TypeName| match file.name() {
        "M" => Some(text.to_owned()),
        "Two" => Some("uint8 a\nuint16 b 7".to_owned()),
        "Empty" => Some(String::new()),
        _ => None,
    };
    Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut texts).unwrap()
}
