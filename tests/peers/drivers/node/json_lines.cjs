// The protocol of drivers for Node.js: operations as JSON lines in, a result for each out.
'use strict';

const readline = require('readline');

/** The server answered with an exception code. */
class Answered extends Error {
    constructor(code) {
        super(`exception ${code}`);
        this.code = code;
    }
}

async function result(execute, operation) {
    try {
        const value = await execute(operation);
        return { value: value === undefined ? null : value };
    } catch (error) {
        if (error instanceof Answered) {
            return { exception: error.code };
        }
        return { error: `${error.name || error.err}: ${error.message}` };
    }
}

/** Executes each operation of standard input, one after the other, and prints its result. */
async function answerAll(execute) {
    for await (const line of readline.createInterface({ input: process.stdin })) {
        console.log(JSON.stringify(await result(execute, JSON.parse(line))));
    }
    process.exit(0);
}

module.exports = { Answered, answerAll };
