package main

import (
	"context"
	"errors"
	"fmt"
	"io"
	"os"
	"strings"
	"time"

	"google.golang.org/grpc/codes"
	"google.golang.org/grpc/status"

	revisitv1 "integrate/gen/revisit/v1"
)

// watch prints what becomes of stored candidates, and goes on where it was after
// whatever broke, this program too: the file keeps the cursor of what was worked off.
func watch(ctx context.Context, client revisitv1.PoseGraphServiceClient, path string) error {
	// By uid of the vehicle: the number of its last event that was worked off.
	told := make(map[string]uint64)
	for attempt := 1; ; attempt++ {
		err := watchOnce(ctx, client, path, told, func() { attempt = 0 })
		if errors.Is(err, io.EOF) {
			// A watch never ends by itself.
			err = status.Error(codes.Unavailable, "the server ended the watch")
		}
		wait, ok := waitBeforeRetry(err, attempt)
		reason := detailsOf(err).info.GetReason()
		switch reason {
		case "CURSOR_TOO_OLD", "CURSOR_UNKNOWN":
			if err := os.Remove(path); err != nil {
				return err
			}
			wait, ok = 100*time.Millisecond, true
		case "SLOW_CONSUMER":
			wait, ok = 100*time.Millisecond, true
		case "":
			reason = codeName(status.Code(err))
		}
		if !ok {
			return err
		}
		fmt.Printf("watch: lost (%s), again in %.1f s\n", reason, wait.Seconds())
		time.Sleep(wait)
	}
}

// watchOnce works off what one call tells.
func watchOnce(ctx context.Context, client revisitv1.PoseGraphServiceClient, path string,
	told map[string]uint64, progressed func()) error {
	ctx, cancel := context.WithCancel(ctx)
	defer cancel()
	cursor, err := os.ReadFile(path)
	if errors.Is(err, os.ErrNotExist) {
		// The events of a store that was restored from a backup have lower numbers.
		clear(told)
		var listed string
		if listed, err = listAll(ctx, client); err == nil {
			cursor, err = []byte(listed), keep(path, listed)
		}
	}
	if err != nil {
		return err
	}
	call, err := client.WatchCandidates(ctx,
		&revisitv1.WatchCandidatesRequest{Cursor: string(cursor)})
	if err != nil {
		return err
	}
	for {
		answer, err := call.Recv()
		if err != nil {
			return err
		}
		if uid, number := identityOf(answer); number > told[uid] {
			reportEvent(answer)
			told[uid] = number
		}
		if err := keep(path, answer.GetCursor()); err != nil {
			return err
		}
		progressed()
	}
}

// listAll prints what is stored, and returns where a watch goes on.
func listAll(ctx context.Context, client revisitv1.PoseGraphServiceClient) (string, error) {
	request := &revisitv1.ListChecksRequest{Parent: "vehicles/-"}
	cursor := ""
	for {
		page, err := client.ListChecks(ctx, request)
		if err != nil {
			return "", err
		}
		if request.PageToken == "" {
			cursor = page.GetWatchCursor()
		}
		for _, check := range page.GetChecks() {
			for _, candidate := range check.GetStates() {
				fmt.Printf("listed: %s\n", textOf(candidate))
			}
		}
		if page.GetNextPageToken() == "" {
			return cursor, nil
		}
		request.PageToken = page.GetNextPageToken()
	}
}

// identityOf returns the uid of the event's vehicle and the event's number, which is 0 for
// a beat.
func identityOf(answer *revisitv1.WatchCandidatesResponse) (string, uint64) {
	if event := answer.GetCandidate(); event != nil {
		return event.GetVehicleUid(), event.GetNumber()
	}
	return answer.GetVehicleDeleted().GetVehicleUid(), answer.GetVehicleDeleted().GetNumber()
}

// reportEvent is where a verifier works. What it does comes to the same if done twice: an
// event comes again if the program ends before its cursor is kept.
func reportEvent(answer *revisitv1.WatchCandidatesResponse) {
	switch event := answer.GetEvent().(type) {
	case *revisitv1.WatchCandidatesResponse_Candidate:
		fmt.Printf("event: %d %s\n", event.Candidate.GetNumber(),
			textOf(event.Candidate.GetCandidate()))
	case *revisitv1.WatchCandidatesResponse_VehicleDeleted:
		fmt.Printf("event: %d %s DELETED\n", event.VehicleDeleted.GetNumber(),
			event.VehicleDeleted.GetVehicle())
	}
}

func textOf(candidate *revisitv1.CheckCandidate) string {
	return candidate.GetName() + " " +
		strings.TrimPrefix(candidate.GetState().String(), "CANDIDATE_STATE_")
}

// keep replaces the file, so that it is never without a cursor.
func keep(path, cursor string) error {
	file, err := os.Create(path + ".partial")
	if err != nil {
		return err
	}
	_, err = file.WriteString(cursor)
	if err = errors.Join(err, file.Sync(), file.Close()); err != nil {
		return err
	}
	return os.Rename(path+".partial", path)
}
