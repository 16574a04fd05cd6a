//! Definitions and messages: no text and no payload panics, with a definition from the input or a built-in one.

use bytes::Bytes;
use sgc_cdr::{Library, TypeName, YamlStyle};

/// Runs one input of the target: a selecting byte, a text with its length (16 bits) in front, and bytes.
pub fn run(input: &[u8]) {
    let Some(input) = crate::choice_text_bytes(input) else { return };
    let (which, text, payload) = input;
    let payload = Bytes::copy_from_slice(payload);
    let show = |layout: sgc_cdr::Layout| {
        if let Ok(value) = layout.decode(&payload) {
            let json = value.to_json();
            assert!(layout.from_json(json.as_bytes()).is_ok(), "{json}");
            value.to_yaml(YamlStyle::default());
            layout.header_stamp_ns(&payload);
            value.at(text);
        }
        assert_eq!(layout.type_hash().len(), "RIHS01_".len() + 64);
    };
    let own: TypeName = ["p/msg/M", "p/srv/M_Request", "p/action/M_FeedbackMessage"][usize::from(which % 3)]
        .parse()
        .expect("a type");
    if let Ok(layout) = Library::empty().layout(&own, &mut |_| Some(text.to_owned())) {
        show(layout);
    }
    if let Some(file) = Library::shipped_files().filter(|file| file.kind() == "msg").nth(usize::from(which)) {
        show(Library::empty().layout(&file, &mut |_| None).expect("what ships has a layout"));
    }
}
