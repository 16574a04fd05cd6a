//! Each op as clients write it: right, with a member missing, with a wrong member.

use super::*;

fn parse(text: &str) -> Result<ClientMessage<'_>, OpError> {
    ClientMessage::parse(text, MessagePlace::Whole)
}

/// Parses an op whose other members are the text.
fn with_op<T>(op: &str, members: &str, read: impl FnOnce(ClientMessage<'_>) -> T) -> T {
    let comma = if members.is_empty() { "" } else { "," };
    let text = format!(r#"{{"op":"{op}"{comma}{members}}}"#);
    read(parse(&text).expect(&text))
}

fn name(text: &str) -> Cow<'_, str> {
    Cow::Borrowed(text)
}

#[test]
fn each_op_is_read_with_its_members() {
    let second = Duration::from_secs(1);
    let offered = |is_latched, size| QosMember::default().offer(is_latched, size);
    let best_effort = QosMember::read(r#"{"reliability":"best_effort","depth":3}"#).unwrap();
    let serve = || ServingAdvertisement { name: name("/s"), type_name: name("t/T") };
    let call = CallService {
        service: name("/s"),
        type_name: None,
        args: None,
        timeout: None,
        fragment_size: None,
        compression: Compression::None,
    };
    let goal = SendActionGoal {
        action: name("/a"),
        type_name: None,
        args: None,
        has_feedback: false,
        fragment_size: None,
        compression: Compression::None,
    };
    let result = |status, values| ActionResult { action: name("/a"), status, values };
    let response = |outcome| ServiceResponse { service: name("/s"), outcome };
    let published = |advertisement| Publish { topic: name("/t"), msg: r#"{"data":[1]}"#, advertisement };
    let not_text = |member, found: &str| Refusal::Kind { member, expected: "text", found: found.into() };
    let implicit = |type_name, qos| Ok(ImplicitAdvertisement { type_name, qos });
    let subscribed = SubscribeTopic {
        topic: name("/t"),
        type_name: None,
        qos: None,
        request: SubscriptionRequest::default(),
    };
    let table = [
        (
            "action_feedback",
            r#""action":"/a","values":{"n":1}"#,
            Op::ActionFeedback(ActionFeedback { action: name("/a"), values: r#"{"n":1}"# }),
        ),
        (
            "action_feedback",
            r#""action":"/a""#,
            Op::ActionFeedback(ActionFeedback { action: name("/a"), values: "{}" }),
        ),
        (
            "action_result",
            r#""action":"/a","values":{"n":1}"#,
            Op::ActionResult(result(GoalStatus::Succeeded, r#"{"n":1}"#)),
        ),
        (
            "action_result",
            r#""action":"/a","result":false,"values":"why""#,
            Op::ActionResult(result(GoalStatus::Aborted, "{}")),
        ),
        (
            "action_result",
            r#""action":"/a","result":false,"status":5"#,
            Op::ActionResult(result(GoalStatus::Canceled, "{}")),
        ),
        ("action_status", r#""action":"/a""#, Op::ActionStatus { action: name("/a") }),
        (
            "advertise",
            r#""topic":"/t","type":"t/T","queue_size":7"#,
            Op::Advertise(AdvertiseTopic {
                topic: name("/t"),
                type_name: Some(name("t/T")),
                qos: offered(false, Some(7)),
            }),
        ),
        (
            "advertise",
            r#""topic":"/t","latch":true"#,
            Op::Advertise(AdvertiseTopic { topic: name("/t"), type_name: None, qos: offered(true, None) }),
        ),
        (
            "advertise",
            r#""topic":"/t","qos":{"reliability":"best_effort","depth":3}"#,
            Op::Advertise(AdvertiseTopic {
                topic: name("/t"),
                type_name: None,
                qos: best_effort.offer(false, None),
            }),
        ),
        ("advertise_action", r#""action":"/s","type":"t/T""#, Op::AdvertiseAction(serve())),
        ("advertise_service", r#""service":"/s","type":"t/T""#, Op::AdvertiseService(serve())),
        ("auth", r#""token":"secret""#, Op::Auth { token: Ok(name("secret")) }),
        ("auth", r#""token":null,"mac":"secret","client":"""#, Op::Auth { token: Ok(name("secret")) }),
        ("auth", "", Op::Auth { token: Err(Refusal::Missing("token")) }),
        ("auth", r#""token":1"#, Op::Auth { token: Err(not_text("token", "1")) }),
        ("auth", r#""mac":[]"#, Op::Auth { token: Err(not_text("mac", "[]")) }),
        ("call_service", r#""service":"/s""#, Op::CallService(CallService { ..call })),
        (
            "call_service",
            r#""service":"/s","type":"t/T","args":[1],"timeout":1,"fragment_size":9,"compression":"cbor-raw""#,
            Op::CallService(CallService {
                service: name("/s"),
                type_name: Some(name("t/T")),
                args: Some("[1]"),
                timeout: Some(second),
                fragment_size: NonZeroUsize::new(9),
                compression: Compression::Cbor,
            }),
        ),
        ("cancel_action_goal", r#""id":1,"action":3"#, Op::CancelActionGoal),
        (
            "fragment",
            r#""id":"f","num":1.0,"total":2,"data":"a\"b""#,
            Op::Fragment(Fragment { id: OpId::Text("f".into()), number: 1, total: 2, data: "a\"b".into() }),
        ),
        (
            "publish",
            r#""topic":"/t","msg":{"data":[1]}"#,
            Op::Publish(published(implicit(None, offered(false, None)))),
        ),
        (
            "publish",
            r#""topic":"/t","msg":{"data":[1]},"type":"t/T","latch":true"#,
            Op::Publish(published(implicit(Some(name("t/T")), offered(true, None)))),
        ),
        (
            "publish",
            r#""topic":"/t","msg":{"data":[1]},"latch":1"#,
            Op::Publish(published(Err(Refusal::Kind {
                member: "latch",
                expected: "bool",
                found: "1".into(),
            }))),
        ),
        ("send_action_goal", r#""action":"/a""#, Op::SendActionGoal(SendActionGoal { ..goal })),
        (
            "send_action_goal",
            r#""action":"/a","action_type":"t/T","type":3,"args":{},"feedback":true,"fragment_size":9,"compression":"cbor""#,
            Op::SendActionGoal(SendActionGoal {
                action: name("/a"),
                type_name: Some(name("t/T")),
                args: Some("{}"),
                has_feedback: true,
                fragment_size: NonZeroUsize::new(9),
                compression: Compression::Cbor,
            }),
        ),
        (
            "service_response",
            r#""service":"/s","values":[true]"#,
            Op::ServiceResponse(response(ServiceOutcome::Reply(Some("[true]")))),
        ),
        (
            "service_response",
            r#""service":"/s","values":"why""#,
            Op::ServiceResponse(response(ServiceOutcome::Reply(None))),
        ),
        (
            "service_response",
            r#""service":"/s","values":"why","result":false"#,
            Op::ServiceResponse(response(ServiceOutcome::Failure(Some(r#""why""#)))),
        ),
        (
            "service_response",
            r#""service":"/s","values":{},"result":false"#,
            Op::ServiceResponse(response(ServiceOutcome::Reply(Some("{}")))),
        ),
        ("set_level", r#""level":"warn""#, Op::SetLevel(Level::Warning)),
        ("status", "", Op::Status),
        ("subscribe", r#""topic":"/t""#, Op::Subscribe(SubscribeTopic { ..subscribed })),
        (
            "subscribe",
            r#""topic":"/t","type":"t/T","throttle_rate":1000,"queue_length":5,"fragment_size":9,"compression":"cbor-raw""#,
            Op::Subscribe(SubscribeTopic {
                topic: name("/t"),
                type_name: Some(name("t/T")),
                qos: None,
                request: SubscriptionRequest {
                    throttle: second,
                    queue_length: 5,
                    fragment_size: NonZeroUsize::new(9),
                    compression: Compression::CborRaw,
                },
            }),
        ),
        (
            "subscribe",
            r#""topic":"/t","queue_length":5,"qos":{"reliability":"best_effort","depth":3}"#,
            Op::Subscribe(SubscribeTopic {
                topic: name("/t"),
                type_name: None,
                qos: best_effort.request(),
                request: SubscriptionRequest { queue_length: 3, ..SubscriptionRequest::default() },
            }),
        ),
        ("unadvertise", r#""topic":"/t""#, Op::Unadvertise { topic: name("/t") }),
        ("unadvertise_action", r#""action":"/a""#, Op::UnadvertiseAction { action: name("/a") }),
        ("unadvertise_service", r#""service":"/s""#, Op::UnadvertiseService { service: name("/s") }),
        ("unsubscribe", r#""topic":"/t""#, Op::Unsubscribe { topic: name("/t") }),
    ];
    for (op, members, wanted) in table {
        with_op(op, members, |message| {
            assert_eq!(message.op, Ok(wanted), "{op} {members}");
            assert_eq!(message.name.to_string(), op);
        });
    }
}

#[test]
fn missing_and_wrong_members_are_named() {
    for (op, members, why) in [
        ("action_feedback", "", r#""action" is missing"#),
        ("action_feedback", r#""action":"/a","values":[1]"#, r#""values" is no object: [1]"#),
        ("action_result", "", r#""action" is missing"#),
        ("action_result", r#""action":"/a","result":0"#, r#""result" is no bool: 0"#),
        ("action_result", r#""action":"/a","status":1.5"#, r#""status" is no integer: 1.5"#),
        ("action_result", r#""action":"/a","status":2"#, "status 2 is no end of a goal"),
        ("action_status", "", r#""action" is missing"#),
        ("action_status", r#""action":1"#, r#""action" is no text: 1"#),
        ("advertise", "", r#""topic" is missing"#),
        ("advertise", r#""topic":"/t","type":1"#, r#""type" is no text: 1"#),
        ("advertise", r#""topic":"/t","qos":1"#, r#""qos" is no object: 1"#),
        (
            "advertise",
            r#""topic":"/t","qos":{"depth":"x"}"#,
            r#""qos": "depth" is no number of 0 or more: "x""#,
        ),
        ("advertise", r#""topic":"/t","latch":1"#, r#""latch" is no bool: 1"#),
        ("advertise", r#""topic":"/t","queue_size":-1"#, r#""queue_size" is no number of 0 or more: -1"#),
        ("advertise_action", "", r#""action" is missing"#),
        ("advertise_action", r#""action":"/a""#, r#""type" is missing"#),
        ("advertise_action", r#""action":"/a","type":[]"#, r#""type" is no text: []"#),
        ("advertise_service", "", r#""service" is missing"#),
        ("advertise_service", r#""service":"/s""#, r#""type" is missing"#),
        ("advertise_service", r#""service":{},"type":"t/T""#, r#""service" is no text: {}"#),
        ("call_service", "", r#""service" is missing"#),
        ("call_service", r#""service":1"#, r#""service" is no text: 1"#),
        ("call_service", r#""service":"/s","type":1"#, r#""type" is no text: 1"#),
        ("call_service", r#""service":"/s","timeout":"x""#, r#""timeout" is no number of seconds: "x""#),
        ("call_service", r#""service":"/s","fragment_size":0"#, r#""fragment_size" is 1 or more"#),
        ("call_service", r#""service":"/s","compression":1"#, r#""compression" is no text: 1"#),
        ("fragment", r#""num":0,"total":1,"data":"""#, r#""id" is missing"#),
        ("fragment", r#""id":1,"total":1,"data":"""#, r#""num" is missing"#),
        ("fragment", r#""id":1,"num":0,"data":"""#, r#""total" is missing"#),
        ("fragment", r#""id":1,"num":0,"total":1"#, r#""data" is missing"#),
        ("fragment", r#""id":1,"num":0.5,"total":1,"data":"""#, r#""num" is no number of 0 or more: 0.5"#),
        ("fragment", r#""id":1,"num":0,"total":1,"data":1"#, r#""data" is no text: 1"#),
        ("png", "", "png is not taken: send JSON"),
        ("publish", r#""msg":{}"#, r#""topic" is missing"#),
        ("publish", r#""topic":"/t""#, r#""msg" is missing"#),
        ("publish", r#""topic":"/t","msg":"x""#, r#""msg" is no object: "x""#),
        ("send_action_goal", "", r#""action" is missing"#),
        ("send_action_goal", r#""action":1"#, r#""action" is no text: 1"#),
        ("send_action_goal", r#""action":"/a","action_type":1"#, r#""action_type" is no text: 1"#),
        ("send_action_goal", r#""action":"/a","type":1"#, r#""type" is no text: 1"#),
        ("send_action_goal", r#""action":"/a","feedback":1"#, r#""feedback" is no bool: 1"#),
        ("send_action_goal", r#""action":"/a","fragment_size":0"#, r#""fragment_size" is 1 or more"#),
        ("service_response", "", r#""service" is missing"#),
        ("service_response", r#""service":"/s","result":1"#, r#""result" is no bool: 1"#),
        ("set_level", "", r#""level" is missing"#),
        ("set_level", r#""level":1"#, r#""level" is no text: 1"#),
        ("set_level", r#""level":"loud""#, r#""level" is none, error, warning or info"#),
        ("subscribe", "", r#""topic" is missing"#),
        ("subscribe", r#""topic":1"#, r#""topic" is no text: 1"#),
        ("subscribe", r#""topic":"/t","qos":[]"#, r#""qos" is no object: []"#),
        (
            "subscribe",
            r#""topic":"/t","queue_length":"x""#,
            r#""queue_length" is no number of 0 or more: "x""#,
        ),
        (
            "subscribe",
            r#""topic":"/t","compression":"zip""#,
            r#"compression is "none", "cbor" or "cbor-raw""#,
        ),
        ("unadvertise", "", r#""topic" is missing"#),
        ("unadvertise", r#""topic":1"#, r#""topic" is no text: 1"#),
        ("unadvertise_action", "", r#""action" is missing"#),
        ("unadvertise_action", r#""action":1"#, r#""action" is no text: 1"#),
        ("unadvertise_service", "", r#""service" is missing"#),
        ("unadvertise_service", r#""service":1"#, r#""service" is no text: 1"#),
        ("unsubscribe", "", r#""topic" is missing"#),
        ("unsubscribe", r#""topic":1"#, r#""topic" is no text: 1"#),
    ] {
        with_op(op, members, |message| {
            let error = message.op.expect_err(members).error;
            assert_eq!(error.to_string(), format!("{op}: {why}"), "{members}");
        });
    }
}

#[test]
fn invalid_call_or_goal_names_the_awaited_reply() {
    let reply = |op, members| with_op(op, members, |message| format!("{:?}", message.op.unwrap_err().reply));
    assert_eq!(reply("call_service", r#""service":"/s","timeout":"x""#), r#"Some(Service("/s"))"#);
    assert_eq!(reply("call_service", r#""service":1"#), r#"Some(Service(""))"#);
    assert_eq!(reply("send_action_goal", r#""action":"/a","feedback":1"#), r#"Some(Action("/a"))"#);
    assert_eq!(reply("subscribe", ""), "None");
}

#[test]
fn place_decides_which_ops_are_accepted() {
    let op = |text, place| {
        let message = ClientMessage::parse(text, place).unwrap();
        message.op.map(drop).map_err(|invalid| (invalid.error.to_string(), invalid.reply.is_some()))
    };
    let call = r#"{"op":"call_service"}"#;
    let unknown = r#"{"op":"dance"}"#;
    for (text, name) in [(call, "call_service"), (unknown, "dance")] {
        let why = format!(r#"{name}: say who you are first: {{"op":"auth","token":"…"}}"#);
        assert_eq!(op(text, MessagePlace::BeforeAdmission), Err((why, false)));
    }
    assert_eq!(op(r#"{"op":"auth","token":"a"}"#, MessagePlace::BeforeAdmission), Ok(()));
    let missing = Err((r#"call_service: "service" is missing"#.to_owned(), true));
    assert_eq!(op(call, MessagePlace::Whole), missing);
    assert_eq!(op(call, MessagePlace::Assembled), missing);
    assert_eq!(op(unknown, MessagePlace::Whole), Err((r#"there is no op "dance""#.to_owned(), false)));
    let nested = Err(("fragment: a message in pieces is no piece itself".to_owned(), false));
    assert_eq!(op(r#"{"op":"fragment"}"#, MessagePlace::Assembled), nested);
}

#[test]
fn messages_without_an_op_or_a_valid_id_are_reported() {
    for wrong in ["[]", "3", "null", "{}", r#"{"op":3}"#, r#"{"op":null}"#] {
        assert_eq!(parse(wrong).unwrap_err(), OpError::NoOp, "{wrong}");
    }
    for wrong in ["", "{", r#"{"op":"x""#, r#"{"op":"x"} x"#, "{'op':1}", "nonsense"] {
        assert!(matches!(parse(wrong).unwrap_err(), OpError::NotJson(_)), "{wrong}");
    }
    let told = parse(r#"{"op":"status","id":1.5}"#).unwrap_err().to_string();
    assert_eq!(told, r#"status: "id" is no text or integer: 1.5"#);
    let long = format!(r#"{{"op":"status","id":"{}"}}"#, "x".repeat(1025));
    assert!(parse(&long).is_err());
    assert_eq!(parse(r#"{"op":"status","id":7}"#).unwrap().id, Some(OpId::Number(7)));
    assert_eq!(parse(r#"{"op":"dance","id":"a"}"#).unwrap().id, Some(OpId::Text("a".into())));
    let deep = format!(
        r#"{{"op":"publish","topic":"/t","msg":{{"a":{}{}}}}}"#,
        "[".repeat(100_000),
        "]".repeat(100_000)
    );
    assert!(parse(&deep).unwrap().op.is_ok());
}

#[test]
fn echoed_text_is_short() {
    let (name, found) = ("ä".repeat(10_000), "x".repeat(10_000));
    let unknown = format!(r#"{{"op":"{name}","id":"{found}"}}"#);
    let wrong = format!(r#"{{"op":"subscribe","topic":"/t","queue_length":"{found}"}}"#);
    let errors = [
        parse(&unknown).unwrap_err(),
        parse(&format!(r#"{{"op":"{name}"}}"#)).unwrap().op.unwrap_err().error,
        parse(&wrong).unwrap().op.unwrap_err().error,
    ];
    for error in errors {
        assert!(error.to_string().len() < 400, "{error}");
    }
}
