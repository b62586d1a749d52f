export function RetunesView() { return null; }
