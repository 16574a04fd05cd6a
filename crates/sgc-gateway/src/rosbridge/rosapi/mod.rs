//! [`RosApi`]: the services of the `rosapi` node, answered by the gateway within the client's view. A `rosapi` node
//! on the network is not asked.

mod params;
mod typedefs;

use std::collections::BTreeSet;

use serde::Deserialize;
use serde_json::{Value as Json, json};
use sgc_cdr::Library;

use super::input;
use super::options::RosbridgeOptions;
use crate::definitions::InterfaceType;
use crate::graph::{Graph, NodeInfo, is_hidden};
use crate::offload::offload;
use crate::session::Session;
use params::ParamError;

/// Longest arguments, in bytes, because errors echo them.
const ARGS_BYTES_MAX: usize = 64 << 10;

/// Returns the name of a service within `rosapi`, or `None` for other services. The leading slash is optional.
pub(super) fn local_name(service: &str) -> Option<&str> {
    service.strip_prefix('/').unwrap_or(service).strip_prefix("rosapi/")
}

/// The arguments of all services.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Args {
    #[serde(rename = "type")]
    type_name: String,
    topic: String,
    service: String,
    action: String,
    node: String,
    name: String,
    value: Json,
    default: String,
}

/// The gateway's replacement of the `rosapi` node.
pub(super) struct RosApi<'s> {
    pub(super) session: &'s Session,
    pub(super) options: &'s RosbridgeOptions,
}

impl RosApi<'_> {
    /// Answers a call, or returns `None` if there is no such service here; the network may have it.
    pub(super) async fn answer(&self, service: &str, args: &str) -> Option<Result<Json, String>> {
        let known = [
            "topics",
            "topics_for_type",
            "topic_type",
            "topics_and_raw_types",
            "services",
            "services_for_type",
            "service_type",
            "service_providers",
            "service_node",
            "service_host",
            "service_request_details",
            "service_response_details",
            "message_details",
            "action_goal_details",
            "action_result_details",
            "action_feedback_details",
            "publishers",
            "subscribers",
            "nodes",
            "node_details",
            "action_servers",
            "action_type",
            "interfaces",
            "get_time",
            "get_ros_version",
            "get_param_names",
            "has_param",
            "get_param",
            "set_param",
            "delete_param",
        ];
        if !known.contains(&service) {
            return None;
        }
        if args.len() > ARGS_BYTES_MAX {
            return Some(Err(format!("the arguments are longer than {ARGS_BYTES_MAX} bytes")));
        }
        // Clients may send no arguments as an empty list.
        let args = if args.starts_with('[') { "{}" } else { args };
        let args: Args = match serde_json::from_str(args) {
            Ok(args) => args,
            Err(error) => return Some(Err(format!("the arguments are not right: {error}"))),
        };
        Some(match service {
            "get_param_names" => Ok(json!({ "names": params::names(self.session).await })),
            "has_param" => Ok(json!({ "exists": params::get(self.session, &args.name).await.is_ok() })),
            "get_param" => Ok(get_param(params::get(self.session, &args.name).await, &args.default)),
            "set_param" => Ok(done(params::set(self.session, &args.name, &args.value).await)),
            "delete_param" => Ok(done(params::delete(self.session, &args.name).await)),
            "get_time" => Ok(time()),
            "get_ros_version" => Ok(json!({ "version": 2, "distro": self.options.ros_distro })),
            "message_details" => self.typedefs(InterfaceType::Message, &args.type_name, ""),
            "service_request_details" => self.typedefs(InterfaceType::Service, &args.type_name, "_Request"),
            "service_response_details" => self.typedefs(InterfaceType::Service, &args.type_name, "_Response"),
            "action_goal_details" => self.typedefs(InterfaceType::Action, &args.type_name, "_Goal"),
            "action_result_details" => self.typedefs(InterfaceType::Action, &args.type_name, "_Result"),
            "action_feedback_details" => self.typedefs(InterfaceType::Action, &args.type_name, "_Feedback"),
            _ => Ok(self.graph_answer(service, &args)),
        })
    }

    fn typedefs(&self, of: InterfaceType, type_name: &str, part: &str) -> Result<Json, String> {
        let full = of.full_name(type_name).map_err(|error| error.to_string())?;
        let found = offload(|| {
            self.session.check_type(&full)?;
            typedefs::typedefs(self.session.hub().types(), &format!("{full}{part}"))
        });
        found.map(|typedefs| json!({ "typedefs": typedefs })).map_err(|error| error.to_string())
    }

    fn graph_answer(&self, service: &str, args: &Args) -> Json {
        let graph = self.session.graph();
        let shown = |name: &&String| !is_hidden(name);
        let topics = || {
            let typed = graph.topics.iter().filter(|(name, _)| shown(name));
            typed.filter_map(|(name, info)| Some((name, info.type_name()?)))
        };
        let services =
            || graph.services.iter().filter(|(name, info)| shown(name) && !info.servers.is_empty());
        let is_type = |of: InterfaceType, actual: &str| {
            of.full_name(&args.type_name).is_ok_and(|wanted| wanted == actual)
        };
        let ends = |pick: fn(&crate::graph::TopicInfo) -> &Vec<crate::graph::EndpointInfo>| {
            let ends = graph.topics.get(&args.topic).map(pick).into_iter().flatten();
            ends.filter_map(|end| end.node.clone()).collect::<BTreeSet<_>>()
        };
        let servers = || {
            let servers = graph.services.get(&args.service).map(|info| &info.servers);
            servers.into_iter().flatten().flatten().cloned().collect::<BTreeSet<_>>()
        };
        match service {
            "topics" => {
                let (names, types): (Vec<_>, Vec<_>) = topics().unzip();
                json!({ "topics": names, "types": types })
            }
            "topics_and_raw_types" => {
                let (names, types): (Vec<_>, Vec<_>) = topics().unzip();
                let types_known = self.session.hub().types();
                let read = || types.iter().map(|of| typedefs::full_text(types_known, of)).collect::<Vec<_>>();
                let texts = offload(read);
                json!({ "topics": names, "types": types, "typedefs_full_text": texts })
            }
            "topics_for_type" => {
                let of_type = topics().filter(|(_, actual)| is_type(InterfaceType::Message, actual));
                json!({ "topics": of_type.map(|(name, _)| name).collect::<Vec<_>>() })
            }
            "topic_type" => {
                let info = graph.topics.get(&args.topic);
                json!({ "type": info.and_then(|info| info.type_name()).unwrap_or_default() })
            }
            "services" => json!({ "services": services().map(|(name, _)| name).collect::<Vec<_>>() }),
            "services_for_type" => {
                let of_type = services().filter(|(_, info)| is_type(InterfaceType::Service, &info.type_name));
                json!({ "services": of_type.map(|(name, _)| name).collect::<Vec<_>>() })
            }
            "service_type" => {
                let info = graph.services.get(&args.service);
                json!({ "type": info.map(|info| info.type_name.as_str()).unwrap_or_default() })
            }
            "service_providers" => json!({ "providers": servers() }),
            "service_node" => json!({ "node": servers().first().cloned().unwrap_or_default() }),
            "service_host" => json!({ "host": "" }),
            "publishers" => json!({ "publishers": ends(|info| &info.publishers) }),
            "subscribers" => json!({ "subscribers": ends(|info| &info.subscribers) }),
            "nodes" => json!({ "nodes": self.nodes(&graph) }),
            "node_details" => {
                let none = NodeInfo::default();
                let node = graph.nodes.get(&args.node).unwrap_or(&none);
                let shown = |names: &BTreeSet<String>| {
                    names.iter().filter(|name| !is_hidden(name)).cloned().collect::<Vec<_>>()
                };
                json!({
                    "subscribing": shown(&node.subscribes),
                    "publishing": shown(&node.publishes),
                    "services": shown(&node.serves),
                })
            }
            "action_servers" => {
                let served = graph.actions.iter().filter(|(_, info)| !info.servers.is_empty());
                json!({ "action_servers": served.map(|(name, _)| name).collect::<Vec<_>>() })
            }
            "action_type" => {
                let info = graph.actions.get(&args.action);
                json!({ "type": info.map(|info| info.type_name.as_str()).unwrap_or_default() })
            }
            _ => json!({ "interfaces": interfaces(&graph) }),
        }
    }

    /// Returns the nodes with a visible interface, and the gateway's own.
    fn nodes(&self, graph: &Graph) -> Vec<String> {
        let own = self.session.hub().node_name();
        let is_seen = |info: &NodeInfo| {
            let all = [&info.publishes, &info.subscribes, &info.serves, &info.calls];
            all.iter().any(|names| !names.is_empty())
        };
        let seen = graph.nodes.iter().filter(|(name, info)| *name == own || is_seen(info));
        seen.map(|(name, _)| name.clone()).collect()
    }
}

/// Returns the types that ship, and those that the client sees on the network.
fn interfaces(graph: &Graph) -> BTreeSet<String> {
    let mut all: BTreeSet<String> = Library::shipped_files().map(|file| file.to_string()).collect();
    all.extend(graph.topics.values().filter_map(|info| info.type_name().map(str::to_owned)));
    all.extend(graph.services.values().map(|info| info.type_name.clone()));
    all.extend(graph.actions.values().map(|info| info.type_name.clone()));
    all.retain(|name| !name.is_empty());
    all
}

/// Returns the time with the names of ROS 2 and of ROS 1, which roslibpy 2 reads.
fn time() -> Json {
    let now = input::now();
    let (sec, nanosec) = (now.as_secs(), now.subsec_nanos());
    json!({ "time": { "sec": sec, "nanosec": nanosec, "secs": sec, "nsecs": nanosec } })
}

fn done(result: Result<(), ParamError>) -> Json {
    match result {
        Ok(()) => json!({ "successful": true, "reason": "" }),
        Err(error) => json!({ "successful": false, "reason": error.to_string() }),
    }
}

/// Returns the answer of `get_param`, whose value is JSON as text.
fn get_param(found: Result<Json, ParamError>, default: &str) -> Json {
    match found {
        Ok(value) => json!({ "value": value.to_string(), "successful": true, "reason": "" }),
        Err(_) if !default.is_empty() => json!({ "value": default, "successful": true, "reason": "" }),
        Err(error) => json!({ "value": "null", "successful": false, "reason": error.to_string() }),
    }
}
