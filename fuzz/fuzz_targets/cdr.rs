//! Definitions and messages: no text and no payload panics, with a definition of the input's own or one that ships.
#![no_main]

use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use sgc_cdr::{Library, TypeName, YamlStyle};

fuzz_target!(|input: (u8, &str, &[u8])| {
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
});
