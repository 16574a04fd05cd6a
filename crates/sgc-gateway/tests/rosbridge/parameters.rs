//! Parameters of nodes, by the services of `rosapi`.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use serde_json::{Value as Json, json};
use sgc_gateway::{Content, Form};

use crate::client::client;
use crate::support::Site;

pub(crate) type Parameters = Arc<Mutex<BTreeMap<String, Json>>>;

/// Serves the services that every node has for its parameters.
pub(crate) async fn serve_parameters(site: &Site, node: &str, parameters: &Parameters) {
    for (service, of) in [
        ("list_parameters", "ListParameters"),
        ("get_parameters", "GetParameters"),
        ("set_parameters", "SetParameters"),
    ] {
        let (name, of) = (format!("{node}/{service}"), format!("rcl_interfaces/srv/{of}"));
        let mut serving = site.session("node").serve(&name, Some(&of)).await.unwrap();
        let parameters = Arc::clone(parameters);
        tokio::spawn(async move {
            while let Some(request) = serving.next().await {
                let asked: Json =
                    serde_json::from_slice(&serving.write(&request, Form::Json).unwrap()).unwrap();
                let reply = answer(&mut parameters.lock().unwrap(), service, &asked);
                serving.replier().reply(request.id, &Content::json(reply.to_string())).await.unwrap();
            }
        });
    }
}

fn answer(parameters: &mut BTreeMap<String, Json>, service: &str, asked: &Json) -> Json {
    match service {
        "list_parameters" => json!({"result": {"names": parameters.keys().collect::<Vec<_>>()}}),
        "get_parameters" => {
            let names = asked["names"].as_array().unwrap().iter();
            let value = |name: &Json| parameters.get(name.as_str().unwrap()).cloned().unwrap_or(json!({}));
            json!({"values": names.map(value).collect::<Vec<_>>()})
        }
        _ => {
            let results = asked["parameters"].as_array().unwrap().iter().map(|parameter| {
                let name = parameter["name"].as_str().unwrap();
                if name == "fixed" {
                    return json!({"successful": false, "reason": "it is read-only"});
                }
                match parameter["value"]["type"].as_u64() {
                    Some(0) => drop(parameters.remove(name)),
                    _ => drop(parameters.insert(name.to_owned(), parameter["value"].clone())),
                }
                json!({"successful": true})
            });
            json!({"results": results.collect::<Vec<_>>()})
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn parameters_are_listed_told_set_and_deleted() {
    let site = Site::new().await;
    let parameters = Parameters::default();
    parameters.lock().unwrap().extend([
        ("speed".to_owned(), json!({"type": 3, "double_value": 0.5})),
        ("fixed".to_owned(), json!({"type": 4, "string_value": "no"})),
    ]);
    serve_parameters(&site, "/arm", &parameters).await;
    let mut browser = client(&site).await;
    let (names, _) = browser.call("rosapi/get_param_names", json!({})).await;
    assert_eq!(names, json!({"names": ["/arm:fixed", "/arm:speed"]}));
    let done = json!({"successful": true, "reason": ""});
    for (service, args, wanted) in [
        (
            "get_param",
            json!({"name": "/arm:speed"}),
            json!({"value": "0.5", "successful": true, "reason": ""}),
        ),
        ("has_param", json!({"name": "arm:speed"}), json!({"exists": true})),
        ("has_param", json!({"name": "/arm:other"}), json!({"exists": false})),
        // An integer stays a double, because the parameter is one.
        ("set_param", json!({"name": "/arm:speed", "value": "2"}), done.clone()),
        (
            "get_param",
            json!({"name": "/arm:speed"}),
            json!({"value": "2.0", "successful": true, "reason": ""}),
        ),
        ("set_param", json!({"name": "/arm:names", "value": "[\"a\",\"b\"]"}), done.clone()),
        (
            "get_param",
            json!({"name": "/arm:names"}),
            json!({"value": r#"["a","b"]"#, "successful": true, "reason": ""}),
        ),
        (
            "set_param",
            json!({"name": "/arm:fixed", "value": "\"yes\""}),
            json!({"successful": false, "reason": "/arm:fixed: the node refuses: it is read-only"}),
        ),
        ("delete_param", json!({"name": "/arm:names"}), done.clone()),
        (
            "get_param",
            json!({"name": "/arm:names", "default": "[]"}),
            json!({"value": "[]", "successful": true, "reason": ""}),
        ),
        (
            "get_param",
            json!({"name": "/arm:names"}),
            json!({"value": "null", "successful": false,
            "reason": "/arm:names is not declared, or the node does not tell"}),
        ),
        (
            "get_param",
            json!({"name": "speed"}),
            json!({"value": "null", "successful": false,
            "reason": "\"speed\" is no name of a parameter: write /node:parameter"}),
        ),
        (
            "set_param",
            json!({"name": "/arm:speed", "value": "{\"a\":1}"}),
            json!({"successful": false, "reason": "/arm:speed: no parameter can have such a value"}),
        ),
    ] {
        let (values, is_done) = browser.call(&format!("rosapi/{service}"), args).await;
        assert_eq!((values, is_done), (wanted, true), "{service}");
    }
}
