package main

import (
	"context"
	"errors"
	"fmt"
	"io"
	"time"

	"google.golang.org/grpc/status"

	revisitv1 "integrate/gen/revisit/v1"
)

const batchSize = 64

// stream streams the poses until all are durable, over as many connections as it takes,
// and returns the accepted candidates that came.
func stream(ctx context.Context, client revisitv1.PoseGraphServiceClient,
	vehicle *revisitv1.Vehicle, poses []*revisitv1.Pose) ([]*revisitv1.Candidate, error) {
	var accepted []*revisitv1.Candidate
	// Whoever outlives this program keeps uid and acked sequence, beside the poses.
	opening := &revisitv1.StreamPosesOpen{
		Vehicle: vehicle.GetName(), VehicleUid: vehicle.GetUid(), SendCandidates: true,
	}
	for attempt := 1; ; attempt++ {
		err := streamOnce(ctx, client, opening, poses, func(answer *revisitv1.StreamPosesResponse) {
			switch message := answer.GetMessage().(type) {
			case *revisitv1.StreamPosesResponse_Opened:
				opening.AckedSequence = message.Opened.GetDurableSequence()
				fmt.Printf("stream: open, durable up to %d\n", opening.AckedSequence)
			case *revisitv1.StreamPosesResponse_Ack:
				opening.AckedSequence = message.Ack.GetDurableSequence()
				attempt = 0
			case *revisitv1.StreamPosesResponse_Candidates:
				accepted = append(accepted, report(message.Candidates)...)
			}
		})
		if err == nil {
			return accepted, nil
		}
		wait, ok := waitBeforeRetry(err, attempt)
		if !ok {
			return nil, err
		}
		fmt.Printf("stream: lost at %d (%s), again in %.1f s\n",
			opening.AckedSequence, codeName(status.Code(err)), wait.Seconds())
		time.Sleep(wait)
	}
}

// streamOnce sends what is not durable yet over one stream, while it hands the answers
// to a function.
func streamOnce(ctx context.Context, client revisitv1.PoseGraphServiceClient,
	opening *revisitv1.StreamPosesOpen, poses []*revisitv1.Pose,
	take func(*revisitv1.StreamPosesResponse)) error {
	ctx, cancel := context.WithCancel(ctx)
	defer cancel()
	call, err := client.StreamPoses(ctx)
	if err != nil {
		return err
	}
	// An error of Send is io.EOF: Recv returns the one that the server sent.
	_ = call.Send(&revisitv1.StreamPosesRequest{
		Message: &revisitv1.StreamPosesRequest_Open{Open: opening},
	})
	for {
		answer, err := call.Recv()
		if errors.Is(err, io.EOF) {
			return nil
		}
		if err != nil {
			return err
		}
		if opened := answer.GetOpened(); opened != nil {
			go send(call, poses[opened.GetDurableSequence():], opened.GetTakesPoseColumns())
		}
		take(answer)
	}
}

// send sends the poses, no faster than the server reads them.
func send(call revisitv1.PoseGraphService_StreamPosesClient, poses []*revisitv1.Pose,
	takesColumns bool) {
	for len(poses) > 0 {
		count := min(batchSize, len(poses))
		// Servers that know no columns take the same poses as messages.
		batch := &revisitv1.PoseBatch{Poses: poses[:count]}
		if takesColumns {
			batch = &revisitv1.PoseBatch{Columns: columnsOf(poses[:count])}
		}
		err := call.Send(&revisitv1.StreamPosesRequest{
			Message: &revisitv1.StreamPosesRequest_Batch{Batch: batch},
		})
		if err != nil {
			return
		}
		poses = poses[count:]
	}
	_ = call.CloseSend()
}

// report prints the candidates that are worth a verifier's look, and returns them.
func report(set *revisitv1.CandidateSet) []*revisitv1.Candidate {
	var accepted []*revisitv1.Candidate
	for _, candidate := range set.GetCandidates() {
		if candidate.GetVerdict() != revisitv1.Verdict_VERDICT_ACCEPTED {
			continue
		}
		fmt.Printf("candidate: %s is %s, probability %.3f\n", place(candidate.GetQuery()),
			place(candidate.GetMatched()), candidate.GetProbability())
		accepted = append(accepted, candidate)
	}
	return accepted
}

func place(node *revisitv1.Node) string {
	return fmt.Sprintf("%d at %s", node.GetSequence(),
		node.GetStamp().AsTime().Format("2006-01-02T15:04:05.000Z"))
}
