// The areas of the Modbus standard: their read functions, and the limits of one read and of one write.

export const AREAS = {
  coils: { title: "Coils", code: 1, most: 2000, mostWritten: 1968 },
  discrete_inputs: { title: "Discrete inputs", code: 2, most: 2000 },
  holding_registers: { title: "Holding registers", code: 3, most: 125, mostWritten: 123 },
  input_registers: { title: "Input registers", code: 4, most: 125 },
};

/** Returns the area that a function code reads. */
export const areaOf = (code) => Object.values(AREAS).find((area) => area.code === code);

export const LAST = 65535;
