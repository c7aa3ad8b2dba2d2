// Judges a history of writes and reads of registers: is it linearizable?
//
// Standard input has one operation a line: register, client, w or r, value, time of the call, and time
// of the return, or -1 if the operation may take effect at any later time, or never.
package main

import (
	"bufio"
	"fmt"
	"math"
	"os"
	"time"

	"github.com/anishathalye/porcupine"
)

type input struct {
	isWrite bool
	value   int
}

var register = porcupine.Model{
	Init: func() interface{} { return 0 },
	Step: func(state, in, out interface{}) (bool, interface{}) {
		operation := in.(input)
		if operation.isWrite {
			return true, operation.value
		}
		return out.(int) == state.(int), state
	},
}

func main() {
	histories := map[int][]porcupine.Operation{}
	operations := 0
	lines := bufio.NewScanner(os.Stdin)
	for lines.Scan() {
		var number, client, value int
		var kind string
		var called, returned int64
		_, err := fmt.Sscan(lines.Text(), &number, &client, &kind, &value, &called, &returned)
		if err != nil {
			fmt.Println("malformed line:", lines.Text(), err)
			os.Exit(2)
		}
		if returned < 0 {
			returned = math.MaxInt64
		}
		operations++
		histories[number] = append(histories[number], porcupine.Operation{
			ClientId: client,
			Input:    input{kind == "w", value},
			Call:     called,
			Output:   value,
			Return:   returned,
		})
	}
	bad := 0
	for number, history := range histories {
		switch porcupine.CheckOperationsTimeout(register, history, time.Minute) {
		case porcupine.Illegal:
			fmt.Println("not linearizable: register", number)
			bad++
		case porcupine.Unknown:
			fmt.Println("not decided within a minute: register", number)
			bad++
		}
	}
	fmt.Println(operations, "operations,", len(histories), "registers,", bad, "bad")
	if bad > 0 {
		os.Exit(1)
	}
}
