//! Streams a drive to revisit, prints where the vehicle has been before, and confirms
//! one of these places.
//!
//! usage: integrate ADDRESS FILE VEHICLE_ID
//!
//! With two arguments it prints what becomes of stored candidates instead.
//!
//! usage: integrate ADDRESS CURSOR_FILE

use std::{error::Error, time::Duration};

use tonic::{
    transport::{Channel, Endpoint},
    Code,
};
use tonic_types::StatusExt;

mod drive;
mod retry;
mod stream;
mod watch;

pub mod revisit {
    pub mod v1 {
        tonic::include_proto!("revisit.v1");
    }
}

use revisit::v1::{
    pose_graph_service_client::PoseGraphServiceClient, AddLoopClosureRequest, AppendPosesRequest,
    Candidate, CreateVehicleRequest, LoopClosure, Pose, Vehicle,
};

type Client = PoseGraphServiceClient<Channel>;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.as_slice() {
        [address, path, vehicle_id] => integrate(connect(address)?, path, vehicle_id).await,
        [address, path] => {
            watch::CandidateWatcher::new(connect(address)?, path)
                .run()
                .await
        }
        _ => Err("usage: integrate ADDRESS FILE VEHICLE_ID | integrate ADDRESS CURSOR_FILE".into()),
    }
}

/// A client that connects once it is used.
fn connect(address: &str) -> Result<Client, tonic::transport::Error> {
    // A connection whose other end has vanished is noticed after half a minute.
    let endpoint = Endpoint::from_shared(format!("http://{address}"))?
        .http2_keep_alive_interval(Duration::from_secs(20))
        .keep_alive_timeout(Duration::from_secs(10));
    Ok(Client::new(endpoint.connect_lazy()))
}

async fn integrate(mut client: Client, path: &str, vehicle_id: &str) -> Result<(), Box<dyn Error>> {
    let poses = drive::read(path)?;
    let request = CreateVehicleRequest {
        vehicle_id: vehicle_id.into(),
        vehicle: None,
    };
    let created = client.create_vehicle(request).await?.into_inner();
    let vehicle = created.vehicle.ok_or("an answer without a vehicle")?;
    println!("vehicle: {}, uid {}", vehicle.name, vehicle.uid);

    let accepted = stream::PoseStreamer::new(client.clone(), &vehicle, &poses)
        .run()
        .await?;
    println!("durable: all {} poses", poses.len());
    confirm(&mut client, &vehicle, &accepted).await?;
    if let Some(last) = poses.last() {
        show_error(&mut client, &vehicle, last.clone()).await;
    }
    Ok(())
}

/// Says of the most probable candidate, if there is one, that it is the same place, as a
/// verifier would after it compared images or scans.
async fn confirm(
    client: &mut Client,
    vehicle: &Vehicle,
    accepted: &[Candidate],
) -> Result<(), Box<dyn Error>> {
    let best = accepted
        .iter()
        .max_by(|a, b| a.probability().total_cmp(&b.probability()));
    let Some(Candidate {
        query: Some(query),
        matched: Some(matched),
        ..
    }) = best
    else {
        return Ok(());
    };
    let request = AddLoopClosureRequest {
        parent: vehicle.name.clone(),
        loop_closure: Some(LoopClosure {
            query_sequence: query.sequence,
            matched_sequence: matched.sequence,
            ..Default::default()
        }),
        ..Default::default()
    };
    let added = client.add_loop_closure(request).await?.into_inner();
    println!("confirmed: {}", added.loop_closure.unwrap_or_default().name);
    Ok(())
}

/// Sends a pose with a variance below 0, which is refused and changes nothing, and prints
/// all that the error says.
async fn show_error(client: &mut Client, vehicle: &Vehicle, mut pose: Pose) {
    pose.sequence += 1;
    if let Some(covariance) = &mut pose.covariance {
        covariance.values[0] = -1.0;
    }
    let request = AppendPosesRequest {
        vehicle: vehicle.name.clone(),
        vehicle_uid: vehicle.uid.clone(),
        poses: vec![pose],
        ..Default::default()
    };
    let Err(error) = client.append_poses(request).await else {
        return;
    };
    if let Some(info) = error.get_details_error_info() {
        let none = String::new();
        println!(
            "refused: {}, reason {} of {}, request {}: {}",
            code_name(error.code()),
            info.reason,
            info.domain,
            info.metadata.get("request_id").unwrap_or(&none),
            error.message()
        );
    }
    if let Some(bad_request) = error.get_details_bad_request() {
        for violation in bad_request.field_violations {
            println!("  {}: {}", violation.field, violation.description);
        }
    }
}

/// The name of a status as most languages write it: INVALID_ARGUMENT for
/// InvalidArgument.
fn code_name(code: Code) -> String {
    let mut name = String::new();
    for letter in format!("{code:?}").chars() {
        if letter.is_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.extend(letter.to_uppercase());
    }
    name
}
