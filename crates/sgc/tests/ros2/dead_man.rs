//! The dead-man switch beside a robot: an operator's rclpy program drives a robot's over a router.

use std::thread;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha8Rng;
use rand_core::{RngCore, SeedableRng};
use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Plan, Site, share, uses};
use crate::support::fake_clock::FakeClock;
use crate::support::{Peer, environment, eventually, say};
use crate::{EXCLUSIVE, PAIRS, PLAN};

const TOPIC: &str = "/cmd_vel";
/// More than `after` of the configuration.
const LET_GO: Duration = Duration::from_millis(1500);
/// Wait for a command that passes at once if it passes.
const HEARD_MAX: Duration = Duration::from_secs(5);
const TRIES_MAX: usize = 10;

/// Returns a lab whose desk shares commands with the robot, and whose robot uses them with these settings.
fn lab(switch: &str) -> Lab {
    let used = uses("topic", TOPIC, "desk") + &format!("deadman = {{ after = \"600ms\", {switch} }}\n");
    Lab::real(EXCLUSIVE, [used, share("topic", TOPIC, "robot")])
}

fn start(lab: &Lab, [at_robot, at_desk]: [&str; 2]) -> (Peer, Peer) {
    let drive = |site, distribution, role: &str| {
        let args = [role, "--topic", TOPIC, "--timeout", PLAN.peer_life];
        let mut peer = lab.rclpy(site, distribution, "drive.py", &args);
        peer.wait("an endpoint", |event| event["event"] == "ready");
        peer
    };
    (drive(Site::Robot, at_robot, "robot"), drive(Site::Desk, at_desk, "operator"))
}

/// Waits until the robot hears this speed. It must hear no other before.
fn next_speed(robot: &mut Peer, speed: f64) {
    let heard = robot.wait("a command", |event| event["event"] == "speed");
    assert_eq!(heard["speed"], speed, "{heard}");
}

/// Lets go, and holds anew, until the robot hears this speed. On a busy machine the switch may miss that somebody let go.
fn hold(operator: &mut Peer, robot: &mut Peer, speed: f64) {
    for _ in 0..TRIES_MAX {
        operator.tell("release");
        thread::sleep(LET_GO);
        operator.tell(&format!("hold {speed}"));
        if let Ok((_, heard)) = robot.events.recv_timeout(HEARD_MAX) {
            return assert_eq!(heard["speed"], speed, "{heard}");
        }
    }
    panic!("the robot does not move");
}

/// Does the same for a robot that may hear a stop message first.
fn hold_at_first(operator: &mut Peer, robot: &mut Peer, speed: f64) {
    operator.tell(&format!("hold {speed}"));
    if let Ok((_, heard)) = robot.events.recv_timeout(HEARD_MAX) {
        assert_eq!(heard["speed"], 0.0, "{heard}");
    }
    hold(operator, robot, speed);
}

fn switch_of(lab: &Lab) -> Value {
    let mut command =
        lab.sgc(Some(Site::Robot), &["topic", "info", "--json", TOPIC, "--socket", "robot.sock"]);
    let output = command.output().unwrap();
    let info: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let of_share = &info["shares"][0]["dead_man"];
    if of_share.is_null() { info["uses"][0]["route"]["dead_man"].clone() } else { of_share.clone() }
}

#[test]
fn a_robot_stops_when_its_operator_is_gone_and_moves_when_somebody_let_go_and_began_again() {
    let lab = lab("publish = \"zero\"");
    let (mut robot, mut operator) = start(&lab, PAIRS[0]);
    // The stop message of the beginning is known to be published before somebody drives, and may come before the robot's
    // program joins.
    eventually("the first stop message", || switch_of(&lab)["stops"].as_u64() > Some(0));
    while robot.events.recv_timeout(LET_GO).is_ok() {}
    hold(&mut operator, &mut robot, 1.0);

    // The operator lets go.
    operator.tell("release");
    next_speed(&mut robot, 0.0);
    hold(&mut operator, &mut robot, 2.0);

    // The way stands still, and the operator does not let go.
    let router = lab.node(Site::Cloud);
    router.signal(Signal::STOP);
    next_speed(&mut robot, 0.0);
    router.signal(Signal::CONT);
    eventually("commands come again, and do not pass", || {
        let switch = switch_of(&lab);
        !switch["stopped"].is_null() && switch["not_resumed"].as_u64() > Some(10)
    });
    let why = lab.why(Site::Robot, TOPIC);
    assert!(why.contains("has not let go since") && why.contains("let go of the control"), "{why}");
    hold(&mut operator, &mut robot, 3.0);

    // The operator's program hangs. When it goes on, its silence counts as a pause.
    operator.signal(Signal::STOP);
    next_speed(&mut robot, 0.0);
    operator.signal(Signal::CONT);
    next_speed(&mut robot, 3.0);

    // Its node is killed.
    lab.node(Site::Desk).signal(Signal::KILL);
    next_speed(&mut robot, 0.0);
    assert!(lab.log(Site::Robot).contains("a dead-man switch stops the robot"), "{}", lab.log(Site::Robot));
}

#[test]
fn a_robot_that_owns_its_commands_stops_and_waits_until_somebody_lets_go() {
    let shared = share("topic", TOPIC, "desk")
        + "type = \"geometry_msgs/msg/Twist\"\npublish = [\"desk\"]\n\
           deadman = { after = \"600ms\", publish = \"zero\" }\n";
    let used = uses("topic", TOPIC, "robot") + "publish = true\n";
    let mut lab = Lab::real(EXCLUSIVE, [shared, used]);
    let (mut robot, mut operator) = start(&lab, PAIRS[1]);
    hold_at_first(&mut operator, &mut robot, 1.0);

    // The operator's node is killed and started again, and the operator does not let go.
    lab.kill(Site::Desk);
    next_speed(&mut robot, 0.0);
    lab.start(Site::Desk);
    eventually("commands come again, and do not pass", || {
        let switch = switch_of(&lab);
        !switch["stopped"].is_null() && switch["not_resumed"].as_u64() > Some(50)
    });
    let why = lab.why(Site::Robot, TOPIC);
    assert!(why.contains("has not let go since"), "{why}");
    assert!(robot.events.try_recv().is_err(), "the robot moves");
    assert!(lab.asked(Site::Robot, &["topic", "resume", TOPIC]).contains("passes"));
    next_speed(&mut robot, 1.0);
    operator.tell("release");
    next_speed(&mut robot, 0.0);
    hold(&mut operator, &mut robot, 2.0);

    // The robot's own node is killed and started again.
    lab.kill(Site::Robot);
    lab.start(Site::Robot);
    next_speed(&mut robot, 0.0);
    hold(&mut operator, &mut robot, 3.0);
}

#[test]
fn a_switch_without_automatic_end_waits_for_somebody_at_the_robot() {
    let lab = lab("publish = \"zero\", repeat = \"100ms\", resume = \"manual\"");
    let (mut robot, mut operator) = start(&lab, PAIRS[0]);
    operator.tell("hold 1");
    // The stop message is repeated until then.
    next_speed(&mut robot, 0.0);
    eventually("its commands come", || switch_of(&lab)["not_resumed"].as_u64() > Some(10));
    assert!(lab.asked(Site::Robot, &["topic", "resume", TOPIC]).contains("passes"));
    next_speed(&mut robot, 1.0);
    operator.tell("release");
    next_speed(&mut robot, 0.0);
    let why = lab.why(Site::Robot, TOPIC);
    assert!(why.contains("sgc topic resume /cmd_vel"), "{why}");
    let stops = switch_of(&lab)["stops"].as_u64();
    eventually("the stop message is repeated", || switch_of(&lab)["stops"].as_u64() > stops);
}

/// A fault while somebody drives.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Fault {
    CableCut,
    RouterFrozen,
    NodeFrozen,
    NodeKilled,
    ProgramHangs,
    ProgramKilled,
    /// The clock of the operator's computer is set back.
    ClockSetBack,
    /// It is set forward, and commands wait at a router meanwhile.
    ClockSetForward,
    /// The node beside the robot is killed and started again.
    RobotNodeKilled,
}

/// All of them, those first that no other test has.
const FAULTS: [Fault; 9] = [
    Fault::CableCut,
    Fault::ClockSetForward,
    Fault::RobotNodeKilled,
    Fault::ClockSetBack,
    Fault::NodeFrozen,
    Fault::ProgramKilled,
    Fault::NodeKilled,
    Fault::ProgramHangs,
    Fault::RouterFrozen,
];

/// A robot and an operator whose computer has a clock of its own.
struct Trial {
    lab: Lab,
    clock: FakeClock,
    /// Seconds by which that clock is ahead.
    ahead: i64,
    robot: Peer,
    operator: Peer,
}

impl Trial {
    fn new(plan: Plan) -> Self {
        let used = uses("topic", TOPIC, "desk") + "deadman = { after = \"600ms\", publish = \"zero\" }\n";
        let mut lab = Lab::silent_real(plan, [used, share("topic", TOPIC, "robot")]);
        let clock = FakeClock::new(lab.dir(), "+0");
        lab.start(Site::Cloud);
        lab.start(Site::Robot);
        start_desk(&mut lab, &clock);
        let robot = lab.rclpy(Site::Robot, "kilted", "drive.py", &drive_args("robot"));
        let operator = start_operator(&lab, &clock);
        Self { lab, clock, ahead: 0, robot, operator }
    }

    /// Lets go and holds anew until the robot hears this speed. It may hear the stop message before.
    fn drive(&mut self, speed: f64) {
        for attempt in 0..30 {
            self.operator.tell("release");
            thread::sleep(LET_GO);
            // Somebody looks at the robot, should the switch not see that somebody let go.
            if attempt > 3 {
                self.lab.asked(Site::Robot, &["topic", "resume", TOPIC]);
            }
            self.operator.tell(&format!("hold {speed}"));
            let until = Instant::now() + HEARD_MAX;
            while let Ok((_, heard)) =
                self.robot.events.recv_timeout(until.saturating_duration_since(Instant::now()))
            {
                if heard["speed"] == speed {
                    return;
                }
                assert!(heard["event"] != "speed" || heard["speed"] == 0.0, "{heard} instead of {speed}");
            }
        }
        panic!("the robot does not move at {speed}");
    }

    fn set_clock(&mut self, by: i64) {
        self.ahead += by;
        self.clock.set(&format!("{:+}", self.ahead));
    }

    fn cable(&self, state: &str) {
        self.lab.namespace(Site::Desk).unwrap().ip(&["link", "set", "cloud", state]).unwrap();
    }

    fn begin(&mut self, fault: Fault) {
        match fault {
            Fault::CableCut => self.cable("down"),
            Fault::RouterFrozen => self.lab.node(Site::Cloud).signal(Signal::STOP),
            Fault::NodeFrozen => self.lab.node(Site::Desk).signal(Signal::STOP),
            Fault::NodeKilled => self.lab.kill(Site::Desk),
            Fault::ProgramHangs => self.operator.signal(Signal::STOP),
            Fault::ProgramKilled => self.operator.signal(Signal::KILL),
            Fault::ClockSetBack => self.set_clock(-5),
            Fault::ClockSetForward => {
                self.lab.node(Site::Cloud).signal(Signal::STOP);
                self.set_clock(5);
            }
            Fault::RobotNodeKilled => {
                self.lab.kill(Site::Robot);
                self.lab.start(Site::Robot);
            }
        }
    }

    /// Ends the fault. Returns whether the robot has to stand still then, because the operator has not let go.
    fn end(&mut self, fault: Fault) -> bool {
        match fault {
            Fault::CableCut => self.cable("up"),
            Fault::RouterFrozen | Fault::ClockSetForward => self.lab.node(Site::Cloud).signal(Signal::CONT),
            Fault::NodeFrozen => self.lab.node(Site::Desk).signal(Signal::CONT),
            Fault::NodeKilled => start_desk(&mut self.lab, &self.clock),
            Fault::ProgramHangs => self.operator.signal(Signal::CONT),
            Fault::ProgramKilled => self.operator = start_operator(&self.lab, &self.clock),
            Fault::ClockSetBack | Fault::RobotNodeKilled => {}
        }
        // A program that goes on has paused.
        fault != Fault::ProgramHangs
    }
}

fn drive_args(role: &str) -> [&str; 5] {
    [role, "--topic", TOPIC, "--timeout", "100000"]
}

fn start_desk(lab: &mut Lab, clock: &FakeClock) {
    let environment = clock.environment();
    lab.start_within(Site::Desk, &environment.each_ref().map(|(key, value)| (*key, value.as_str())));
}

fn start_operator(lab: &Lab, clock: &FakeClock) -> Peer {
    let mut command = lab.ros(Site::Desk, "jazzy", "drive.py");
    command.args(drive_args("operator")).envs(clock.environment());
    let mut operator = Peer::start(command);
    operator.wait("the operator", |event| event["event"] == "ready");
    operator
}

/// `make dead-man` has many trials.
#[test]
fn in_random_trials_the_robot_stops_and_no_old_command_moves_it() {
    let trials: usize = environment("SGC_DEAD_MAN_TRIALS", 3);
    let seed: u64 = environment("SGC_DEAD_MAN_SEED", 29);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut below = |n: u64| rng.next_u64() % n;
    // Many trials measure times.
    let mut trial = Trial::new(if trials > FAULTS.len() { EXCLUSIVE } else { PLAN });
    if trial.lab.namespace(Site::Desk).is_none() {
        return;
    }
    let mut took = Vec::new();
    for number in 0..trials {
        // Each at least once.
        let fault = FAULTS.get(number).copied().unwrap_or(FAULTS[below(FAULTS.len() as u64) as usize]);
        let speed = (number + 1) as f64;
        trial.drive(speed);
        thread::sleep(Duration::from_millis(below(500)));
        let begun = Instant::now();
        trial.begin(fault);
        // A robot whose node is started anew is stopped as soon as that has a writer.
        next_speed(&mut trial.robot, 0.0);
        let stopped = begun.elapsed();
        took.push((stopped, fault));
        thread::sleep(Duration::from_millis(below(2000)));
        if trial.end(fault) {
            let heard = trial.robot.events.recv_timeout(Duration::from_millis(1000 + below(1000)));
            let moves = heard.is_ok_and(|(_, heard)| heard["speed"] != 0.0);
            assert!(!moves, "seed {seed}, trial {number}, {fault:?}: the robot moves by itself");
        } else {
            while trial.robot.events.recv_timeout(LET_GO).is_ok() {}
        }
        say(&format!("trial {number}: {fault:?}, stopped after {} ms", stopped.as_millis()));
    }
    took.sort_by_key(|(stopped, _)| *stopped);
    let at = |part: usize| took[(took.len() - 1) * part / 100];
    say(&format!("stopped after: p50 {:?}, p99 {:?}, longest {:?}", at(50), at(99), at(100)));
}
