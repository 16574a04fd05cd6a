//! [`Types`]: what messages look like, by the names of their types.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use sgc_cdr::{Layout, Library, TypeError, TypeName};

use crate::aside::aside;
use crate::error::GatewayError;

/// Types remembered; when there are more, all are looked up anew.
const TYPES_MAX: usize = 4096;

/// Where definitions are found beyond those that ship inside. Calls may block for as long as reading a file takes.
pub trait FindDefinitions: Send + Sync + 'static {
    /// The text of the file that defines this type.
    fn text(&self, file: &TypeName) -> Option<String>;

    /// The type as another node described it, if it has this hash.
    fn described(&self, name: &TypeName, hash: Option<&str>) -> Option<Arc<Layout>>;
}

/// Nothing but what ships inside.
#[derive(Clone, Copy, Debug, Default)]
pub struct Shipped;

impl FindDefinitions for Shipped {
    fn text(&self, _file: &TypeName) -> Option<String> {
        None
    }

    fn described(&self, _name: &TypeName, _hash: Option<&str>) -> Option<Arc<Layout>> {
        None
    }
}

/// Which kind of interface a type is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InterfaceType {
    /// Of a topic.
    Message,
    /// Of a service.
    Service,
    /// Of an action.
    Action,
}

impl InterfaceType {
    fn words(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::Message => ("msg", "topic", "std_msgs/msg/String"),
            Self::Service => ("srv", "service", "std_srvs/srv/SetBool"),
            Self::Action => ("action", "action", "example_interfaces/action/Fibonacci"),
        }
    }

    /// The full name of a type: `std_msgs/String`, as ROS 1 had it and programs still say it, is `std_msgs/msg/String`.
    pub fn full_name(self, name: &str) -> Result<String, GatewayError> {
        let (kind, what, example) = self.words();
        let full = match name.split('/').collect::<Vec<_>>()[..] {
            [package, short] => format!("{package}/{kind}/{short}"),
            _ => name.to_owned(),
        };
        // The parts of an action are services and messages of a package's actions.
        let fits = |name: &TypeName| name.kind() == kind || name.kind() == "action";
        match full.parse::<TypeName>() {
            Ok(parsed) if fits(&parsed) => Ok(full),
            _ => Err(GatewayError::TypeName { name: name.to_owned(), what, example }),
        }
    }
}

/// By name, and by the hash that was asked for.
type Known = BTreeMap<(String, Option<String>), Arc<Layout>>;

/// What messages look like.
pub struct Types {
    finder: Box<dyn FindDefinitions>,
    known: Mutex<Known>,
}

impl fmt::Debug for Types {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Types").finish_non_exhaustive()
    }
}

impl Types {
    /// Asks `finder` first, then takes what ships inside.
    pub fn new(finder: impl FindDefinitions) -> Self {
        Self { finder: Box::new(finder), known: Mutex::default() }
    }

    /// What messages of a type look like: by a definition here if it has that hash, else as another node described them.
    /// Where no hash is said the first that is found is taken. May read files.
    pub fn layout(&self, type_name: &str, hash: Option<&str>) -> Result<Arc<Layout>, GatewayError> {
        let key = (type_name.to_owned(), hash.map(str::to_owned));
        if let Some(known) = self.lock().get(&key) {
            return Ok(Arc::clone(known));
        }
        let name: TypeName = type_name.parse().map_err(|_| GatewayError::TypeName {
            name: type_name.to_owned(),
            what: "message",
            example: "std_msgs/msg/String",
        })?;
        let find = || Library::empty().layout(&name, &mut |file| self.finder.text(file));
        let found = aside(find).map(Arc::new);
        let is_it = |layout: &Arc<Layout>| hash.is_none_or(|hash| layout.type_hash() == hash);
        let mut is_sure = true;
        let layout = match found {
            Ok(layout) if is_it(&layout) => layout,
            found => match (aside(|| self.finder.described(&name, hash)), found) {
                (Some(described), _) => described,
                // A hash that says otherwise may be of another way to compute it; what does not fit is found when decoding. Or
                // the description is on its way.
                (None, Ok(layout)) => {
                    is_sure = false;
                    layout
                }
                (None, Err(error)) => return Err(GatewayError::Definition(error)),
            },
        };
        if !is_sure {
            return Ok(layout);
        }
        let mut known = self.lock();
        if known.len() >= TYPES_MAX {
            known.clear();
        }
        known.insert(key, Arc::clone(&layout));
        Ok(layout)
    }

    /// The text of the file that defines a type, among it all of a service's or an action's parts.
    pub fn text(&self, type_name: &str) -> Result<String, GatewayError> {
        let unknown = |name: TypeName| GatewayError::Definition(TypeError::Unknown { name, needed_by: None });
        let name: TypeName = type_name.parse().map_err(|_| GatewayError::TypeName {
            name: type_name.to_owned(),
            what: "message",
            example: "std_msgs/msg/String",
        })?;
        let file = TypeName::new(name.package(), name.kind(), name.file_stem());
        let file = file.ok_or_else(|| unknown(name.clone()))?;
        aside(|| self.finder.text(&file)).or_else(|| Library::shipped(&file)).ok_or_else(|| unknown(name))
    }

    /// Returns the file that defines an interface and the files that its parts need. May read them.
    pub(crate) fn files_of(&self, file: &TypeName) -> BTreeSet<TypeName> {
        let parts: &[&str] = match file.kind() {
            "srv" => &["_Request", "_Response"],
            "action" => &["_Goal", "_Result", "_Feedback"],
            _ => &[""],
        };
        let mut files = BTreeSet::from([file.clone()]);
        let mut library = Library::empty();
        for part in parts {
            let Ok(part) = format!("{file}{part}").parse() else { continue };
            // A type that is known by its description alone has no files.
            let _ = library.layout(&part, &mut |needed| {
                files.insert(needed.clone());
                self.text(&needed.to_string()).ok()
            });
        }
        files
    }

    fn lock(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_names_are_those_of_ros_1() {
        let full = |of: InterfaceType, name: &str| of.full_name(name);
        assert_eq!(full(InterfaceType::Message, "std_msgs/String").unwrap(), "std_msgs/msg/String");
        assert_eq!(full(InterfaceType::Service, "std_srvs/SetBool").unwrap(), "std_srvs/srv/SetBool");
        assert_eq!(
            full(InterfaceType::Message, "a/action/B_FeedbackMessage").unwrap(),
            "a/action/B_FeedbackMessage"
        );
        for wrong in ["String", "std_msgs/srv/String", "", "a/b/c/d", "std msgs/String"] {
            assert!(full(InterfaceType::Message, wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_is_found_comes_before_what_ships() {
        struct One;
        impl FindDefinitions for One {
            fn text(&self, file: &TypeName) -> Option<String> {
                (file.to_string() == "mine/msg/A").then(|| "int32 a".to_owned())
            }
            fn described(&self, _: &TypeName, _: Option<&str>) -> Option<Arc<Layout>> {
                None
            }
        }
        let types = Types::new(One);
        assert!(
            types.layout("mine/msg/A", None).is_ok() && types.layout("std_msgs/msg/String", None).is_ok()
        );
        assert!(types.layout("mine/msg/B", None).is_err());
        assert!(types.text("std_srvs/srv/SetBool_Request").unwrap().contains("---"));
    }
}
