//! Generates the client from the protos, with the `protoc` of the machine.

const PROTO: &str = "../../../proto";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files = ["pose_graph_service", "error_reason"]
        .map(|name| format!("{PROTO}/revisit/v1/{name}.proto"));
    tonic_prost_build::configure()
        .build_server(false)
        .build_transport(false)
        .compile_protos(&files, &[PROTO.to_string()])?;
    println!("cargo:rerun-if-changed={PROTO}");
    Ok(())
}
